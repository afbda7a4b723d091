"""The page says what the published rows say, and is the one that the repository has."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from published_data import DOCS, cells, make_published

# isort: split
from published import TASKS, Published, write_published
from results_page import check_results_page, make_results_page, write_results_page

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation import ResultRow
from torchrl_bmrl.reports import paper, task_name


@pytest.fixture(scope="module")
def page() -> str:
    return make_results_page(make_published()).text


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    """A folder with CSV files of two runs on two tasks, and their page."""
    published = make_published()
    few = [e for e in published.episodes if e.row.policy in ("expert", "bcq")]
    write_published(tmp_path / "results", replace(published, episodes=few))
    write_results_page(tmp_path)
    return tmp_path


def main_rows() -> list[ResultRow]:
    return [e.row for e in make_published().episodes if e.preset == "paper"]


def returns(policy: str, task: str, source: str = "") -> list[float]:
    return [
        r.episode_return
        for r in main_rows()
        if (r.policy, r.task, r.latent_source) == (policy, task, source)
    ]


def share(policy: str, reference: str, task: str, source: str = "") -> float:
    return float(np.mean(returns(policy, task, source)) / np.mean(returns(reference, task)))


def ends(cell: str) -> tuple[float, float]:
    low, high = re.search(r"\[(.*), (.*)\]", cell).groups()  # type: ignore[union-attr]
    return float(low), float(high)


# The repository's own


def test_the_page_of_this_repository_is_what_its_files_give() -> None:
    check_results_page(DOCS)
    for path in (DOCS / "results").iterdir():
        assert path.stat().st_size < 1_000_000
    for path in (DOCS / "images").glob("results*.png"):
        assert path.stat().st_size < 100_000


# Writing and checking


def test_a_page_that_was_just_written_is_up_to_date(docs: Path) -> None:
    check_results_page(docs)
    assert (docs / "images" / "results_curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["results.md", "results/episodes.csv"])
def test_a_number_that_was_changed_is_found(docs: Path, name: str) -> None:
    path = docs / name
    text = path.read_text()
    number = {"results.md": r"(?<=^\| Lift \| 136\.45 \| 206\.40 \| )151"}.get(
        name, r"(?<=^paper,none,lift,bcq,,1,0,)\d+"
    )
    changed, count = re.subn(number, "99", text, count=1, flags=re.MULTILINE)
    assert count == 1
    path.write_text(changed)
    with pytest.raises(DataError, match=r"results\.md: line \d+ is '.*', the CSV files give '.*'"):
        check_results_page(docs)


@pytest.mark.parametrize("name", ["results.md", "images/results_curves.png"])
def test_a_missing_file_is_found(docs: Path, name: str) -> None:
    (docs / name).unlink()
    with pytest.raises(DataError, match=name):
        check_results_page(docs)


# What it says


def test_the_papers_tables_are_recomputed_with_intervals_around_the_shares(page: str) -> None:
    first = cells(page, "Table 1: stage 1, one BCQ policy per task")
    second = cells(page, "Table 2: stage 2, one distilled policy for all tasks")
    for task, one, two in zip(TASKS, first, second, strict=True):
        assert float(one["Paper: BCQ"]) == paper.TABLE_1[task].bcq_return
        assert one["Here: epochs"] == "10"
        for cell, expected in (
            (one["Here: BCQ/expert"], share("bcq", "expert", task)),
            (two["prototype: % of BCQ"], share("distilled", "bcq", task, "prototype")),
        ):
            assert cell.startswith(f"{expected:.1%} ")
            low, high = ends(cell)
            assert low < 100 * expected < high
    assert "online: return" not in second[0]


def test_targets_are_met_where_the_worst_task_meets_them(page: str) -> None:
    lines = {line["What"]: line for line in cells(page, "Targets")}
    assert len(lines) == 5
    worst = min(share("distilled", "bcq", task, "prototype") for task in TASKS)
    met = lines["Distilled: return as a share of BCQ's"]
    assert met["Measured"].startswith(f"{worst:.1%} (")
    assert met["Met"] == "no"  # 1 / 1.02
    assert {lines["BCQ: success"]["Met"], lines["Distilled: success"]["Met"]} == {"yes"}
    accuracy = lines["Accuracy of the task classifier on held-out transitions"]
    assert accuracy["Measured"] == "98.8% (seed 2)"
    low = lines["BCQ over the expert: lower end of the interval of the relative difference"]
    lows = [ends(line["Relative difference"])[0] for line in over_the_expert(page, "BCQ")[:6]]
    assert low["Measured"].startswith(f"{min(lows):+.1f}% (")
    assert low["Met"] == "yes"


def over_the_expert(page: str, policy: str) -> list[dict[str, str]]:
    table = cells(page, "Difference to the expert, and probability of improvement")
    return [line for line in table if line["Policy"] == policy]


def test_targets_are_left_out_where_a_task_is_missing() -> None:
    published = make_published()
    some = [e for e in published.episodes if e.row.task != "lift"]
    page = make_results_page(replace(published, episodes=some)).text
    assert [line["What"][:8] for line in cells(page, "Targets")] == ["Accuracy"]


def test_differences_and_probabilities_are_recomputed(page: str) -> None:
    lines = over_the_expert(page, "BCQ")
    assert [line["Task"] for line in lines] == [*map(task_name, TASKS), "Mean over tasks"]
    rows = main_rows()
    chances = []
    for task, line in zip(TASKS, lines, strict=False):
        assert line["Relative difference"].startswith(f"{share('bcq', 'expert', task) - 1:+.1%} ")
        by_seed = [
            [
                [r.episode_return for r in rows if (r.policy, r.task, r.seed) == (p, task, seed)]
                for p in ("bcq", "expert")
            ]
            for seed in (1, 2)
        ]
        chances.append(np.mean([np.greater.outer(*pair).mean() for pair in by_seed]))
        assert line["P(X > Y)"].startswith(f"{chances[-1]:.0%} ")
    assert lines[-1]["P(X > Y)"].startswith(f"{np.mean(chances):.0%} ")


def test_seeds_stand_side_by_side(page: str) -> None:
    lines = cells(page, "By training seed")
    assert [line["Seed"] for line in lines] == ["1", "2"]
    assert [line["Accuracy"] for line in lines] == ["98.9%", "98.8%"]


def test_the_default_source_is_marked_and_first(page: str) -> None:
    lines = cells(page, "The distilled policy by its source of m")
    assert [line["Policy"] for line in lines] == ["prototype (default)", "online"]
    expected = share("distilled", "bcq", "lift", "online")
    assert lines[1]["Lift"] == f"{expected:.1%} (100%)"


def test_the_fall_of_the_spread_is_that_of_the_curves(page: str) -> None:
    for line in cells(page, "Standard deviation of the returns, early and late"):
        early, late = np.mean([20 / 1, 20 / 2]), np.mean([20 / 9, 20 / 10])
        assert float(line["Std, first fifth"]) == pytest.approx(early, abs=0.05)
        assert float(line["Std, last fifth"]) == pytest.approx(late, abs=0.05)
        assert line["Last / first"] == f"{late / early:.0%}"


def test_baselines_stand_beside_both_stages_under_their_names(page: str) -> None:
    lines = {line["Policy"]: line for line in cells(page, "Policies and tasks")}
    assert list(lines) == ["BCQ", "Distilled", "BC", "BCQ, one-hot task"]
    assert lines["BC"]["Lift"] == f"{share('bc', 'expert', 'lift'):.1%} (83%)"
    published = make_published().episodes
    for name, policy in (("BCQ", "bcq"), ("BC", "bc")):
        seeds = {e.row.seed for e in published if e.row.policy == policy and e.preset == "paper"}
        assert lines[name]["Seeds"] == ", ".join(map(str, sorted(seeds)))
    gains = {line["Policies"]: line for line in cells(page, "What each stage adds")}
    assert list(gains) == [
        "BCQ over Expert",
        "BCQ over BC",
        "Distilled over BCQ",
        "Distilled over BCQ, one-hot task",
    ]
    mean = np.mean([share("bcq", "bc", task) - 1 for task in TASKS])
    assert gains["BCQ over BC"]["Mean over tasks"].startswith(f"{mean:+.1%} ")


def test_an_ablation_stands_beside_the_run_of_its_own_preset_and_seed(page: str) -> None:
    lines = cells(page, "One thing changed")
    assert {line["Change"] for line in lines} == {"dim4"}
    assert {line["Preset"] for line in lines} == {"quick"}
    assert [line["Policy"] for line in lines] == ["BCQ", "Distilled", "BC", "BCQ, one-hot task"]
    for line in lines:
        assert 49.0 < float(line["Return"].split("%")[0]) < 51.0  # the paper's runs have others
    assert lines[1]["Accuracy"] == "98.9%"
    assert lines[2]["Lift: success"] == "83%"


def test_every_run_has_its_command_and_its_minutes(page: str) -> None:
    commands = re.findall(r"^python recipes/two_stage\.py .*$", page, re.MULTILINE)
    assert commands == [run.command for run in make_published().runs]
    lines = cells(page, "Minutes of each stage")
    assert [(line["Stage 1"], line["Stage 2"]) for line in lines] == [("10.0", "–")] * 4


def test_sections_without_data_are_left_out() -> None:
    published = make_published()
    two_arms = [e for e in published.episodes if e.row.policy in ("expert", "bcq")]
    main = replace(published, episodes=[e for e in two_arms if e.preset == "paper"], curves=[])
    page = make_results_page(main)
    headings = re.findall(r"^## (.*)$", page.text, re.MULTILINE)
    assert headings == [
        "In short",
        "The paper's tables",
        "Over the expert",
        "Running times",
        "How to reproduce the runs",
        "Why returns differ from the paper's",
        "What was tried",
        "Everything measured",
    ]
    assert page.curves is None
    assert "![" not in page.text
    assert "## In short" not in make_results_page(Published()).text


# What it says of the tasks


@pytest.mark.robosuite
def test_what_the_page_says_of_rewards_and_experts_is_so() -> None:
    from torchrl_bmrl.envs import skills
    from torchrl_bmrl.envs import table as scene
    from torchrl_bmrl.experts import controllers

    text = " ".join(make_results_page(Published()).text.split())
    low, high = scene.TARGET_LOW, scene.TARGET_HIGH
    farthest = np.maximum(high - scene.HOME, scene.HOME - low)
    farthest = np.linalg.norm(farthest) + scene.HOME_RADIUS
    still = skills.push_velocity_reward(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    hover = skills.reach_reward(scene.HOVER_HEIGHT)
    gains = controllers.ExpertGains()
    assert f"{hover:.2f} at 10 cm, {skills.reach_reward(0.05):.3f} at 5 cm" in text
    assert "box of {:.0f} × {:.0f} × {:.0f} cm".format(*(100 * (high - low))) in text
    assert np.all((low < scene.HOME) & (high > scene.HOME))
    assert farthest < 0.29
    assert skills.reach_reward(farthest) > 0.3
    assert skills.reach_reward(0.21) == pytest.approx(
        paper.TABLE_1["reach"].expert_return / 200, abs=0.01
    )
    assert f"cube at rest is {still:.2f}" in text
    assert f"return {200 * hover:.0f} on lift and {200 * (hover + still):.0f} on a push" in text
    assert (gains.speed_limit, gains.contact_speed_limit) == (1.0, 0.7)
    assert (controllers.POSITION_SCALE, 1 / scene.CONTROL_FREQUENCY) == (0.05, 0.05)
