"""The page on weak demonstrations says what the published rows say."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from published_data import DOCS, Arm, cells, make_published, make_run
from weak_data import ARMS, make_weak, make_weak_rows

# isort: split
from published import TASKS, Published, write_published
from results_page import make_results_page
from targets import best_source, covered, weak_targets_table
from weak_page import check_weak_page, make_weak_page, write_weak_page
from weak_tables import pushes_table, steps_table

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation import ResultRow, summarise
from torchrl_bmrl.reports import task_name

BCQ, EXPERT, REFERENCE = ("bcq", ""), ("expert", ""), ("reference", "")
PROTOTYPE, ONLINE, BC, IQL = (
    ("distilled", "prototype"),
    ("distilled", "online"),
    ("bc", ""),
    ("iql", ""),
)
LINES = [
    *(f"BCQ over the expert: {task_name(task)}" for task in TASKS),
    "BCQ: success",
    "Distilled (prototype): return as a share of BCQ's",
    "Distilled (prototype): success",
    "BCQ minus BC: paired difference, mean over tasks",
    "BCQ minus BC: paired difference, lowest task",
    "BCQ minus IQL: paired difference, mean over tasks",
    "BCQ minus IQL: paired difference, lowest task",
]


@pytest.fixture(scope="module")
def page() -> str:
    return make_weak_page(make_weak()).text


def lines_of(rows: list[ResultRow]) -> dict[str, dict[str, str]]:
    table = weak_targets_table(rows, summarise(rows, TASKS))
    return {line[0]: dict(zip(table.header, line, strict=True)) for line in table.rows}


def returns(rows: list[ResultRow], arm: Arm, task: str) -> np.ndarray:
    mine = [r for r in rows if (r.policy, r.latent_source, r.task) == (*arm, task)]
    return np.array([r.episode_return for r in sorted(mine, key=lambda r: (r.seed, r.episode))])


# Targets


def test_everything_that_was_asked_for_can_be_met() -> None:
    lines = lines_of(make_weak_rows())
    assert list(lines) == LINES
    assert {line["Met"] for line in lines.values()} == {"yes"}


def on_all(arm: Arm, share: float) -> dict[tuple[Arm, str], float]:
    return {(arm, task): share for task in TASKS}


RATIOS = (1.27, 1.51, 1.85, 1.24, 1.55, 1.61)


@pytest.mark.parametrize(
    ("missed", "change"),
    [
        *(
            ({line}, {"shares": {(a, task): ratio - 0.03 for a in (BCQ, PROTOTYPE)}})
            for line, task, ratio in zip(LINES, TASKS, RATIOS, strict=False)
        ),
        ({LINES[6]}, {"failures": {(BCQ, "lift"): 2}}),
        ({LINES[7]}, {"shares": {(PROTOTYPE, "push_up"): 1.84}}),
        ({LINES[8]}, {"failures": {(PROTOTYPE, "push_down"): 2}}),
        ({LINES[10]}, {"shares": {(BC, "reach"): 1.95}}),
        ({LINES[9], LINES[10]}, {"shares": on_all(BC, 1.95)}),
        ({LINES[12]}, {"shares": {(IQL, "reach"): 1.95}}),
        ({LINES[11], LINES[12]}, {"shares": on_all(IQL, 1.95)}),
    ],
)
def test_each_line_can_be_missed(missed: set[str], change: dict[str, Any]) -> None:
    lines = lines_of(make_weak_rows(**change))
    assert {what for what, line in lines.items() if line["Met"] == "no"} == missed


def test_a_ratio_that_is_just_reached_is_met() -> None:
    shares = {
        (arm, task): r + 0.02
        for arm in (BCQ, PROTOTYPE)
        for task, r in zip(TASKS, RATIOS, strict=True)
    }
    lines = lines_of(make_weak_rows(shares=shares))
    for what, ratio in zip(LINES, RATIOS, strict=False):
        assert lines[what]["Asked"] == f"at least {ratio:.0%}"
        assert lines[what]["Met"] == "yes"


def test_a_mean_difference_whose_interval_contains_zero_is_not_met() -> None:
    rows = [row for row in make_weak_rows() if row.policy != "bc"]
    rows += [
        replace(row, policy="bc", episode_return=row.episode_return + (-1) ** row.episode)
        for row in rows
        if row.policy == "bcq"
    ]
    lines = lines_of(rows)
    assert {what for what, line in lines.items() if line["Met"] == "no"} == {LINES[9]}


def test_iql_with_tuned_coefficients_has_lines_of_its_own() -> None:
    rows = make_weak_rows()
    tuned = [replace(row, policy="IQL (expectile 0.5)") for row in rows if row.policy == "iql"]
    lines = lines_of(rows + tuned)
    added = [line.replace("IQL", "IQL (expectile 0.5)") for line in LINES[-2:]]
    assert list(lines) == LINES + added
    assert lines[added[0]]["Measured"] == lines[LINES[-2]]["Measured"]
    others = [replace(row, policy="BC, best episodes (share 0.5)") for row in tuned]
    assert list(lines_of(rows + others)) == LINES


def test_a_task_that_is_significantly_below_counts_beside_one_with_a_wider_interval() -> None:
    rows = [row for row in make_weak_rows() if row.policy != "iql"]
    for row in [row for row in rows if row.policy == "bcq"]:
        more = {"reach": 1.0, "lift": 40.0 * (-1) ** row.episode}.get(row.task, -10.0)
        rows.append(replace(row, policy="iql", episode_return=row.episode_return + more))
    line = lines_of(rows)[LINES[12]]
    assert line["Met"] == "no"
    assert line["Measured"].endswith("(Reach)")


@pytest.mark.parametrize(("share", "met"), [(1.47, "yes"), (1.43, "no")])
def test_where_the_ratio_is_out_of_reach_the_distance_to_the_optimum_counts(
    share: float, met: str
) -> None:
    shares = {(REFERENCE, "push_right"): 1.5, (BCQ, "push_right"): share}
    rows = make_weak_rows(shares=shares | {(PROTOTYPE, "push_right"): share})
    line = lines_of(rows)["BCQ over the expert: Push Right"]
    assert line["Met"] == met
    assert line["Asked"] == (
        "90% of the distance to the scripted optimum (150%); the paper's 185% is above it"
    )
    bcq, expert, best = (returns(rows, a, "push_right").mean() for a in (BCQ, EXPERT, REFERENCE))
    part = (bcq - expert) / (best - expert)
    assert line["Measured"].startswith(f"{part:.1%} [")
    assert f"of the distance; {bcq / expert:.1%} [" in line["Measured"]


def test_the_covered_distance_has_an_interval_around_it_and_none_without_a_distance() -> None:
    rows = make_weak_rows()
    part = covered(rows, BCQ, "lift")
    assert part is not None
    assert part.low < part.value < part.high < 1.0
    assert covered(rows, EXPERT, "lift").value == pytest.approx(0.0)  # type: ignore[union-attr]
    assert covered(rows, REFERENCE, "lift").value == pytest.approx(1.0)  # type: ignore[union-attr]
    low = make_weak_rows(shares={(REFERENCE, "lift"): 0.9})
    assert covered(low, BCQ, "lift") is None
    assert lines_of(low)["BCQ over the expert: Lift"]["Met"] == "yes"  # above the optimum
    no_reference = [row for row in rows if row.policy != "reference"]
    assert covered(no_reference, BCQ, "lift") is None
    assert lines_of(no_reference)["BCQ over the expert: Lift"]["Asked"] == "at least 151%"


def test_one_source_of_m_has_to_do_on_all_tasks() -> None:
    shares: Mapping[tuple[Arm, str], float] = {(PROTOTYPE, "reach"): 1.5, **on_all(ONLINE, 1.88)}
    rows = make_weak_rows(shares=shares)
    assert best_source(make_weak_rows()) == PROTOTYPE
    assert best_source(rows) == ONLINE
    lines = lines_of(rows)
    assert lines["Distilled (online): return as a share of BCQ's"]["Met"] == "yes"
    shares = {**shares, (ONLINE, "lift"): 1.55}
    lines = lines_of(make_weak_rows(shares=shares))
    assert lines["Distilled (online): return as a share of BCQ's"]["Met"] == "no"
    without = [r for r in rows if (r.latent_source, r.task) != ("online", "lift")]
    assert best_source(without) == PROTOTYPE


def test_lines_without_data_are_left_out() -> None:
    rows = [r for r in make_weak_rows() if r.policy not in ("iql", "distilled")]
    assert list(lines_of(rows)) == [*LINES[:7], *LINES[9:11]]
    some = [r for r in make_weak_rows() if r.task != "lift"]
    assert list(lines_of(some)) == [LINES[0], *LINES[2:6]]


# The page


def test_the_page_lists_every_policy_and_the_paired_differences(page: str) -> None:
    lines = cells(page, "Returns and success")
    assert [line["Policy"] for line in lines] == [
        "Expert",
        "Scripted optimum",
        "BCQ",
        "Distilled (online)",
        "Distilled (prototype)",
        "BC",
        "IQL",
    ]
    rows = [e.row for e in make_weak().episodes]
    assert lines[1]["Lift"] == f"{returns(rows, REFERENCE, 'lift').mean():.1f}, 100%"
    paired = cells(page, "Differences on the same starts")
    assert {line["Reference"] for line in paired} == {"BC", "IQL"}
    assert "13 of 13 targets are met." in page
    assert "Preset `weak_paper`, training seeds 1, 2; 1,680 evaluated episodes." in page


def test_a_missed_target_is_named_in_short() -> None:
    run = make_run("weak_paper")
    rows = make_weak_rows(failures={(BCQ, "lift"): 2})
    page = make_weak_page(Published().with_run(run, rows, [])).text
    assert "12 of 13 targets are met. Not met:\n\n- BCQ: success\n" in page


def test_ablations_of_stage_1_alone_are_read_from_the_last_rollouts(page: str) -> None:
    lines = cells(page, "Presets with and without a change")
    found = [(line["Preset"], line["Change"], line["Seeds"], line["Episodes"]) for line in lines]
    assert found == [("weak", "none", "0, 1", "2"), ("weak", "dim4", "0", "2")]
    for line, mean, rate in zip(lines, (300.0, 150.0), (100, 0), strict=True):
        assert {line[task_name(task)] for task in TASKS} == {f"{mean} ({rate}%)"}
    assert [line["Share"] for line in lines] == ["–", "50.0% [50.0, 50.0]"]
    assert "for preset weak, those of the rollouts after each epoch of stage 1" in page
    assert {c.epoch for c in make_weak().curves if c.preset == "weak"} == {4}


def test_ablations_with_an_evaluation_are_read_from_it() -> None:
    published = make_weak()
    for seed in (0, 1):
        published = published.with_run(make_run("weak", seed=seed), make_weak_rows(seed), [])
    table = steps_table(published)
    assert "rollouts after each epoch" in table.caption  # dim4 has none
    half = [replace(r, episode_return=r.episode_return / 2) for r in make_weak_rows(0)]
    table = steps_table(published.with_run(make_run("weak", "dim4", 0), half, []))
    assert "for preset weak, those of the evaluation." in table.caption
    assert [line[-1] for line in table.rows] == ["20", "20"]
    assert table.rows[1][-3] == "50.0% [50.0, 50.0]"


def test_diagnostics_stand_by_run_and_task(page: str) -> None:
    lines = cells(page, "Candidates and critics")
    assert [line["Seed"] for line in lines] == ["1", "2"]
    assert [lines[0][task_name(t)] for t in (TASKS[0], TASKS[1], TASKS[-1])] == [
        "0.90, +0.25, 10%",
        "0.90, –, 10%",
        "–",
    ]


def test_pushes_are_counted_in_intervals_of_their_return_with_their_successes() -> None:
    def row(task: str, value: float, success: bool) -> ResultRow:
        return ResultRow(
            task=task, policy="bcq", seed=1, episode=0, episode_return=value, success=success
        )

    rows = [row("push_up", 249.9, False), row("push_down", 250.0, True), row("lift", 260.0, True)]
    rows += [row("push_left", 299.0, False), row("push_left", 400.0, True)]
    assert pushes_table(rows).rows == [
        ("below 250", "0", "1 (0%)", "0"),
        ("250 to 300", "0", "2 (50%)", "0"),
        ("300 to 350", "0", "0", "0"),
        ("350 to 400", "0", "0", "0"),
        ("400 or more", "0", "1 (100%)", "0"),
    ]
    assert not pushes_table([row("lift", 260.0, True)]).rows


def test_sections_without_data_are_left_out(page: str) -> None:
    def headings(text: str) -> list[str]:
        return re.findall(r"^## (.*)$", text, re.MULTILINE)

    assert headings(page) == [
        "In short",
        "Every policy and task",
        "Paired differences",
        "Where the pushes fall short",
        "Ablations of stage 1",
        "Diagnostics of stage 1",
        "How the settings were chosen",
        "Running times",
        "How to reproduce the runs",
        "Everything measured",
    ]
    assert "`recipes/train_bcq.py`, record its demonstrations once" in page
    rows = [row for row in make_weak_rows() if row.policy in ("expert", "bcq")]
    little = make_weak_page(Published().with_run(make_run("weak_paper"), rows, [])).text
    assert headings(little) == [
        "In short",
        "Every policy and task",
        "Where the pushes fall short",
        "How the settings were chosen",
        "Running times",
        "How to reproduce the runs",
        "Everything measured",
    ]
    assert "### Targets" in little
    experts = [row for row in rows if row.policy == "expert"]
    least = make_weak_page(Published().with_run(make_run("weak_paper"), experts, [])).text
    assert "### Targets" not in least
    assert "train_bcq" not in little
    assert "baselines.py" not in little


# Files


def test_what_is_written_is_up_to_date_and_a_change_is_found(tmp_path: Path) -> None:
    write_published(tmp_path / "results" / "weak", make_weak())
    path = write_weak_page(tmp_path)
    assert path == tmp_path / "weak.md"
    check_weak_page(tmp_path)
    path.write_text(path.read_text().replace("13 of 13", "14 of 13"))
    with pytest.raises(DataError, match=r"weak\.md: line \d+ is '.*14 of 13"):
        check_weak_page(tmp_path)
    path.unlink()
    with pytest.raises(DataError, match=r"weak\.md"):
        check_weak_page(tmp_path)


def test_without_runs_there_is_no_page(tmp_path: Path) -> None:
    write_published(tmp_path / "results", make_published())
    assert write_weak_page(tmp_path) is None
    assert not (tmp_path / "weak.md").exists()
    check_weak_page(tmp_path)


def test_the_page_of_this_repository_is_what_its_files_give() -> None:
    check_weak_page(DOCS)
    for path in (DOCS / "results").glob("weak/*"):
        assert path.stat().st_size < 1_000_000


def test_the_reference_is_no_baseline_of_the_other_page() -> None:
    rows = [replace(row, policy="reference") for row in make_weak_rows() if row.policy == "bc"]
    expert = [row for row in make_weak_rows() if row.policy in ("expert", "bcq")]
    text = make_results_page(Published().with_run(make_run(), rows + expert, [])).text
    assert "## Beside other algorithms" not in text


@pytest.mark.robosuite
def test_what_the_page_says_of_the_pushes_is_so() -> None:
    from torchrl_bmrl.envs import skills

    text = " ".join(make_weak_page(Published()).text.split())
    u = np.array([1.0, 0.0, 0.0])
    still, along, against = (skills.push_velocity_reward(v * u, u) for v in (0.0, 0.1, -0.1))
    assert f"{still:.2f} at rest, {along:.2f} at 10 cm/s along u, {against:.2f} at" in text
    assert skills.PUSH_SUCCESS_DISTANCE == 0.07


def test_the_made_up_rows_have_every_policy() -> None:
    assert {(r.policy, r.latent_source) for r in make_weak_rows()} == set(ARMS)
