"""Tables say what the rows say, figures show their data, the page stands alone."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.evaluation import ResultRow, summarise, write_results
from torchrl_bmrl.evaluation.embedding import STAGE_TAIL
from torchrl_bmrl.reports import (
    Embeddings,
    Section,
    Table,
    behaviour_trajectories,
    embedding_paths,
    embedding_scatter,
    embedding_stages,
    embedding_trajectories,
    embedding_tsne,
    goal_distance_table,
    measure_goal_distance,
    measure_stages,
    paper,
    read_stage1_curves,
    results_table,
    stage1_curves,
    stages_table,
    table_1,
    table_2,
    task_colors,
    task_titles,
    write_page,
    write_report,
)
from torchrl_bmrl.reports.drawing import _lab

ARMS = [("expert", ""), ("bcq", ""), ("distilled", "prototype"), ("distilled", "online")]


TASKS = tuple(paper.TABLE_1)
TITLES = task_titles(TASKS)
NAMES = list(TITLES.values())
TABLES = ("results", "table1", "table2", "stages", "goal_distance")


def make_rows(tasks: tuple[str, ...] = TASKS) -> list[ResultRow]:
    rng = np.random.default_rng(0)
    return [
        ResultRow(
            task=task,
            policy=policy,
            latent_source=source,
            seed=seed,
            episode=episode,
            episode_return=float(rng.normal(200, 20)),
            success=bool(rng.random() < 0.8),
        )
        for task in tasks
        for policy, source in ARMS
        for seed in (0, 1)
        for episode in range(5)
    ]


def make_embeddings(dim: int = 2) -> Embeddings:
    """Six tasks of three episodes of eight steps, in a shuffled order."""
    rng = np.random.default_rng(1)
    task, episode, step = (a.ravel() for a in np.meshgrid(range(6), range(3), range(8)))
    shuffle = rng.permutation(task.size)
    task, episode, step = task[shuffle], episode[shuffle], step[shuffle]
    latent = rng.normal(size=(task.size, dim)) + 5.0 * task[:, None]
    return Embeddings(
        tasks=TASKS,
        task_latent=latent,
        task=task,
        episode=episode,
        step=step,
        distance=0.3 / (1 + step),
        success=step >= 6,
        phase=np.where(task == 0, 0, step // 3),
        phase_names={
            t: ("reach",) if t == "reach" else ("descend", "grasp", "lift") for t in TASKS
        },
        baselines={"raw transition": rng.normal(size=(task.size, 5))},
    )


def make_known(dim: int = 2, seed: int = 0) -> Embeddings:
    """Embeddings whose stages lie apart, and whose distance to the goal is that to the origin."""
    data = make_embeddings(dim)
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(3, dim))[data.phase]
    direction += 0.05 * rng.normal(size=direction.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    way = np.where(data.step < 6, data.distance, 0.0)
    return replace(data, task_latent=40.0 * way[:, None] * direction)


def mean(rows: list[ResultRow], task: str, policy: str, source: str = "") -> float:
    returns = [
        r.episode_return
        for r in rows
        if (r.task, r.policy, r.latent_source) == (task, policy, source)
    ]
    return sum(returns) / len(returns)


def cells(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def write_curves(run_dir: Path, task: str, rows: list[tuple[object, ...]]) -> Path:
    path = run_dir / "bcq" / task / "evaluations.csv"
    path.parent.mkdir(parents=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("epoch", "update", "episode", "return", "success"), *rows])
    return path


class Resources(HTMLParser):
    """Everything that the page asks a browser to load, and its elements' names."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]


# Tables


def test_the_papers_percentages_follow_from_its_returns_but_for_two() -> None:
    off = []
    for task in TASKS:
        share = paper.TABLE_2[task].distilled_return / paper.TABLE_1[task].bcq_return
        if f"{share:.0%}" != paper.TABLE_2[task].printed_percent.rstrip("*"):
            off.append((task, f"{share:.0%}"))
    assert off == [("lift", "117%"), ("push_up", "97%")]


def test_table_1_is_recomputed_from_the_rows() -> None:
    rows = make_rows()
    table = cells(table_1(summarise(rows), epochs={"lift": 12}))
    for task, line in zip(TASKS, table, strict=True):
        expert, bcq = mean(rows, task, "expert"), mean(rows, task, "bcq")
        assert line["Here: expert"] == f"{expert:.1f}"
        assert line["Here: BCQ"] == f"{bcq:.1f}"
        assert line["Here: BCQ/expert"] == f"{100 * bcq / expert:.1f}%"
        assert float(line["Paper: BCQ"]) == paper.TABLE_1[task].bcq_return
        assert float(line["Paper: expert"]) == paper.TABLE_1[task].expert_return
    assert [line["Here: epochs"] for line in table] == ["–", "12", "–", "–", "–", "–"]


def test_table_2_is_recomputed_from_the_rows_for_every_source() -> None:
    rows = make_rows()
    table = cells(table_2(summarise(rows), default_source="prototype"))
    for task, line in zip(TASKS, table, strict=True):
        for source in ("prototype", "online"):
            distilled = mean(rows, task, "distilled", source)
            share = 100 * distilled / mean(rows, task, "bcq")
            assert line[f"{source}: return"] == f"{distilled:.1f}"
            assert line[f"{source}: % of BCQ"] == f"{share:.1f}%"
        assert float(line["Paper: return"]) == paper.TABLE_2[task].distilled_return
        assert line["Paper: % of BCQ"] == paper.TABLE_2[task].printed_percent


def test_the_default_source_comes_first() -> None:
    summaries = summarise(make_rows())
    for first, second in (("online", "prototype"), ("prototype", "online")):
        header = list(table_2(summaries, default_source=first).header)
        assert header.index(f"{first}: return") < header.index(f"{second}: return")


def test_results_table_holds_every_summary() -> None:
    summaries = summarise(make_rows())
    lines = cells(results_table(summaries))
    assert len(lines) == len(summaries) == len(TASKS) * len(ARMS)
    for summary, line in zip(summaries, lines, strict=True):
        low, high = summary.return_interval
        assert line["Mean return"] == f"{summary.mean_return:.1f}"
        assert line["Return 95% interval"] == f"[{low:.1f}, {high:.1f}]"
        assert line["Success"] == f"{100 * summary.success_rate:.0f}%"
        assert (line["Source of m"], line["Episodes"], line["Seeds"]) == (
            summary.latent_source,
            "10",
            "2",
        )


def test_what_was_not_measured_is_a_dash() -> None:
    summaries = [s for s in summarise(make_rows(("lift",))) if s.policy != "bcq"]
    table = table_2(summaries, default_source="prototype", titles=TITLES)
    lift = cells(table)[TASKS.index("lift")]
    assert lift["prototype: return"] != "–"
    assert lift["prototype: % of BCQ"] == "–"
    assert cells(table_1(summaries, titles=TITLES))[0]["Here: expert"] == "–"


def test_markdown_html_and_csv_hold_the_same_cells() -> None:
    table = Table(
        title="T", caption="C", header=("A|B", "N"), rows=[("x|y", "1.5"), ("<b>", "[2, 3]")]
    )
    assert table.markdown().splitlines()[4:] == [
        "| A\\|B | N |",
        "| :--- | ---: |",
        "| x\\|y | 1.5 |",
        "| <b> | [2, 3] |",
    ]
    assert list(csv.reader(io.StringIO(table.csv()))) == [["A|B", "N"], *map(list, table.rows)]
    html = table.html()
    assert "<b>" not in html
    assert re.findall(r"<t[dh]( class=\"number\")?>(.*?)</", html) == [
        ("", "A|B"),
        (' class="number"', "N"),
        ("", "x|y"),
        (' class="number"', "1.5"),
        ("", "&lt;b&gt;"),
        (' class="number"', "[2, 3]"),
    ]


# Figures


def trajectories(*arguments: Any, **options: Any) -> bytes:
    return embedding_trajectories(*arguments, title="Reach", **options)


@pytest.mark.parametrize("count", [6, 14, 24])
def test_colors_are_far_apart_and_do_not_change_with_the_number_of_tasks(count: int) -> None:
    colors = task_colors(count)
    assert colors[:3] == task_colors(3)
    assert len(colors) == count
    lab = _lab(np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colors]))
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)[~np.eye(count, dtype=bool)]
    assert apart.min() > 25.0  # a just noticeable difference is about 2
    assert lab[:, 0].max() < 80.0  # dark enough on white


def test_figures_repeat_exactly_and_change_with_the_data() -> None:
    data = make_embeddings()
    moved = data.task_latent + data.step[:, None]
    curve = [(e, 10 * e, np.array([1.0 * e, 2.0 * e])) for e in (1, 2, 3)]
    draws = [
        lambda m: embedding_scatter(m, data.task, NAMES),
        lambda m: embedding_tsne(m, data.task, NAMES, seed=0),
        lambda m: trajectories(m, data.episode, data.distance),
        lambda m: trajectories(m, data.episode, data.distance, success_point=m[0]),
        lambda m: embedding_stages(m, data.phase, data.step // 3, ("a", "b", "c")),
        lambda m: stage1_curves({"lift": curve}, expert_means={"lift": float(m.sum())}),
        lambda m: embedding_paths(
            m, data.task, NAMES, {"straight": [m[:5]], "curve": [m[3:7]]}, m[:2]
        ),
        lambda m: behaviour_trajectories(
            {"line": np.tile(m, (1, 1, 2))[..., :3]}, {"line": m[:1, :1]}
        ),
    ]
    for draw in draws:
        image = draw(data.task_latent)
        assert image.startswith(b"\x89PNG")
        assert len(image) < 300_000
        assert draw(data.task_latent) == image
        assert draw(moved) != image


def test_colors_follow_task_and_distance() -> None:
    data = make_embeddings()
    swapped = (data.task + 1) % 6
    latent = data.task_latent
    assert embedding_scatter(latent, data.task, NAMES) != embedding_scatter(latent, swapped, NAMES)
    assert trajectories(latent, data.episode, data.distance) != trajectories(
        latent, data.episode, data.distance[::-1]
    )


@pytest.mark.parametrize("dim", [1, 3])
def test_embeddings_of_other_sizes_are_drawn(dim: int) -> None:
    data = make_embeddings(dim)
    for image in (
        embedding_scatter(data.task_latent, data.task, NAMES),
        embedding_tsne(data.task_latent[:40], data.task[:40], NAMES),
        trajectories(data.task_latent, data.episode, data.distance),
        trajectories(
            data.task_latent, data.episode, data.distance, success_point=data.task_latent[0]
        ),
        embedding_stages(data.task_latent[:40], data.phase[:40], data.phase[:40], ("a", "b", "c")),
        embedding_paths(
            data.task_latent, data.task, NAMES, {"curve": [data.task_latent]}, np.eye(1, dim)
        ),
    ):
        assert image.startswith(b"\x89PNG")


def test_figures_refuse_what_they_cannot_draw() -> None:
    with pytest.raises(BMRLError, match="no curve"):
        stage1_curves({})
    with pytest.raises(BMRLError, match=r"\[0, 6\).*7"):
        embedding_scatter(np.zeros((1, 2)), np.array([7]), NAMES)
    with pytest.raises(BMRLError, match="at least 4"):
        embedding_tsne(np.zeros((3, 2)), np.zeros(3, dtype=int), NAMES)
    with pytest.raises(BMRLError, match="no trajectory"):
        trajectories(np.zeros((0, 2)), np.zeros(0, dtype=int), np.zeros(0))
    with pytest.raises(BMRLError, match="no trajectory"):
        behaviour_trajectories({}, {})


def test_embeddings_refuse_what_does_not_fit() -> None:
    zeros = np.zeros(3, dtype=int)
    fits: dict[str, Any] = {
        "tasks": ["reach"],
        "task_latent": np.zeros((3, 2)),
        "task": zeros,
        "episode": zeros,
        "step": zeros,
        "distance": np.zeros(3),
    }
    for name, value in (
        ("task_latent", np.zeros(3)),
        ("task_latent", np.full((3, 2), np.nan)),
        ("task", zeros + 1),
        ("step", np.zeros(4, dtype=int)),
        ("distance", np.full(3, np.inf)),
        ("success", np.zeros((3, 1), dtype=bool)),
        ("baselines", {"raw": np.zeros((2, 5))}),
        ("phase_names", {"reach": ()}),
    ):
        message = {"baselines": "raw", "phase_names": r"phase contains \[0\] for reach"}
        with pytest.raises(BMRLError, match=message.get(name, name)):
            Embeddings(**{**fits, name: value})


# What the embedding knows


@pytest.mark.parametrize("dim", [2, 5])
def test_stages_and_distances_that_are_there_are_found(dim: int) -> None:
    training, held_out = make_known(dim), make_known(dim, seed=0)
    stages = measure_stages(training, held_out)
    assert [r.task for r in stages] == [t for t in TASKS if t != "reach"]
    for result in stages:
        # Three episodes of eight steps, all within the tail after success at step 6.
        assert (result.episodes, result.transitions) == (3, 24)
        assert result.agreement["embedding"].value > result.agreement["raw transition"].value
    distances = measure_goal_distance(training, held_out)
    assert [r.task for r in distances] == list(TASKS)
    for result in distances:
        assert result.correlation["embedding"].value > 0.95
        assert abs(result.correlation["raw transition"].value) < 0.9
        assert result.lowest <= result.correlation["embedding"].value
        assert result.spread is not None
        assert result.spread.value == 0.0


def test_what_happens_after_success_changes_no_number() -> None:
    data = make_known()
    after = data.step > 6
    noise = np.random.default_rng(0).normal(size=data.task_latent.shape)
    moved = replace(
        data,
        task_latent=np.where(after[:, None], noise, data.task_latent),
        phase=np.where(after, 0, data.phase),
        distance=np.where(after, 9.0, data.distance),
    )
    assert measure_goal_distance(moved, moved) == measure_goal_distance(data, data)
    sooner = replace(data, success=data.step >= 3)
    assert measure_goal_distance(data, sooner) != measure_goal_distance(data, data)
    # Stages look further, by STAGE_TAIL steps.
    late = [replace(x, step=np.where(after, x.step + STAGE_TAIL, x.step)) for x in (data, moved)]
    assert measure_stages(late[0], late[0]) == measure_stages(late[1], late[1])
    assert measure_stages(data, data) != measure_stages(moved, moved)


def test_groups_are_found_in_training_data_alone() -> None:
    data = make_known()
    only_one = data.rows(data.episode == 0)
    alone = {r.task: r for r in measure_stages(data, only_one)}
    # Were they found in what they are measured on, the other training data would not matter.
    other = replace(data, task_latent=np.random.default_rng(1).normal(size=data.task_latent.shape))
    assert any(r.agreement != alone[r.task].agreement for r in measure_stages(other, only_one))


def test_the_tables_hold_what_was_measured() -> None:
    data = make_known()
    stages, distances = measure_stages(data, data), measure_goal_distance(data, data)
    for result, line in zip(stages, cells(stages_table(stages)), strict=True):
        assert line["Phases"] == "descend, grasp, lift"
        assert line["Embedding"] == str(result.agreement["embedding"])
        assert line["Raw transition"] == str(result.agreement["raw transition"])
        assert (line["Episodes"], line["Transitions"]) == ("3", "24")
    for result, line in zip(distances, cells(goal_distance_table(distances)), strict=True):
        assert line["Embedding"] == str(result.correlation["embedding"])
        assert line["Lowest episode"] == f"{result.lowest:.2f}"
        assert line["Spread, success over start"] == str(result.spread)


def test_the_report_says_what_it_could_not_measure(tmp_path: Path) -> None:
    write_results(tmp_path / "results.csv", make_rows())
    data = replace(make_known(), phase_names={}, success=np.zeros(144, dtype=bool))
    page = write_report(
        tmp_path, default_source="online", facts={}, embeddings=data, training=data
    ).read_text(encoding="utf-8")
    assert "stages are left out: no phases" in page
    assert "distances are left out: no training demonstration succeeds" in page
    assert {p.stem for p in (tmp_path / "tables").iterdir()} == {"results", "table1", "table2"}


# Page and report


def test_the_page_escapes_what_it_is_given(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    table = Table(title=evil, caption=evil, header=(evil,), rows=[(evil,)])
    section = Section(heading=evil, paragraphs=[evil], tables=[table])
    path = tmp_path / "page.html"
    write_page(path, title=evil, facts={evil: evil}, sections=[section])
    text = path.read_text(encoding="utf-8")
    assert "script" not in Resources(text).tags
    # title and h1, name and value of the fact, heading, paragraph, four parts of the table
    assert text.count("&lt;script&gt;alert(1)&lt;/script&gt;") == 10


def test_a_whole_report_is_written_and_stands_alone(tmp_path: Path) -> None:
    write_results(tmp_path / "results.csv", make_rows())
    for task in TASKS:
        write_curves(tmp_path, task, [(1, 50, 0, 10.0, 0), (2, 100, 0, 20.0, 1)])
    page = write_report(
        tmp_path,
        default_source="prototype",
        facts={"seed": "0"},
        embeddings=make_embeddings(),
        training=make_embeddings(),
        accuracy=0.987,
    )
    files = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert files - {"results.csv"} - {f"bcq/{task}/evaluations.csv" for task in TASKS} == {
        "report.html",
        *(f"tables/{n}.{e}" for n in TABLES for e in ("md", "csv")),
        *(
            f"figures/{n}.png"
            for n in (
                "stage1_curves",
                "embedding",
                "embedding_tsne",
                "embedding_stages",
                "embedding_trajectories",
            )
        ),
    }
    text = page.read_text(encoding="utf-8")
    resources = Resources(text)
    assert len(resources.links) == resources.tags.count("img") == 5
    assert all(link.startswith("data:image/png;base64,") for link in resources.links)
    assert not re.search(r"https?:|url\(|@import", text)
    assert {"script", "link", "iframe"}.isdisjoint(resources.tags)
    assert "98.7%" in text
    assert "left out" not in text
    assert "Here: epochs" in (tmp_path / "tables" / "table1.md").read_text(encoding="utf-8")
    epochs = [line["Here: epochs"] for line in cells_of(tmp_path / "tables" / "table1.csv")]
    assert epochs == ["2"] * 6


def cells_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


def test_tasks_without_returns_or_distances_have_a_report(tmp_path: Path) -> None:
    """A dozen tasks that only have recorded data: no episodes, phases, goals or successes."""
    rng = np.random.default_rng(0)
    names = [f"my_tasks:pour_{i}" for i in range(12)]
    task = np.repeat(np.arange(12), 10)
    data = Embeddings(
        tasks=names,
        task_latent=rng.normal(size=(120, 3)) + task[:, None],
        task=task,
        episode=task // 12,
        step=np.tile(np.arange(10), 12),
    )
    table = Table(title="Held-out data", caption="C", header=("Task", "Q"), rows=[("Pour 0", "1")])
    page = write_report(
        tmp_path,
        facts={},
        titles={names[1]: "Water"},
        tables={"held_out": table},
        embeddings=data,
        training=data,
        accuracy=0.9,
    )
    text = page.read_text(encoding="utf-8")
    assert "90.0% of the cases." in text  # and not the paper's number
    assert "Held-out data" in text
    assert "trajectories are left out: no distance" in text
    assert (tmp_path / "tables" / "held_out.csv").read_text() == table.csv()
    assert {p.stem for p in (tmp_path / "tables").iterdir()} == {"held_out"}
    assert {p.stem for p in (tmp_path / "figures").iterdir()} == {"embedding", "embedding_tsne"}


def test_returns_of_other_tasks_stand_alone_and_an_unknown_success_is_a_dash(
    tmp_path: Path,
) -> None:
    rows = [replace(row, success=None) for row in make_rows(("pour", "ant"))]
    mine = [replace(row, policy="mine") for row in rows if row.policy == "bcq"]
    write_results(tmp_path / "results.csv", [*rows, *mine])
    text = write_report(tmp_path, facts={}, titles={"ant": "Ant v5"}).read_text(encoding="utf-8")
    first = cells_of(tmp_path / "tables" / "table1.csv")
    assert [line["Task"] for line in first] == ["Ant v5", "Pour"]
    assert not [name for name in first[0] if name.startswith("Paper")]
    assert {line["Here: BCQ success"] for line in first} == {"–"}
    assert first[1]["Here: BCQ"] == f"{mean(rows, 'pour', 'bcq'):.1f}"
    lines = cells_of(tmp_path / "tables" / "results.csv")
    assert {(line["Success"], line["Success 95% interval"]) for line in lines} == {("–", "–")}
    assert [line["Policy"] for line in lines if line["Task"] == "Pour"][-1] == "mine"
    assert "solved" not in text
    assert "The distilled policy&#39;s return is between" in text


def test_the_summary_counts_the_successes(tmp_path: Path) -> None:
    rows = make_rows(("reach", "lift"))
    write_results(tmp_path / "results.csv", rows)
    text = write_report(tmp_path, default_source="online", facts={}).read_text(encoding="utf-8")
    for policy, source in (("bcq", ""), ("distilled", "online")):
        solved = sum(r.success for r in rows if (r.policy, r.latent_source) == (policy, source))
        assert f"solved {solved} of 20 episodes" in text
    shares = [mean(rows, t, "distilled", "online") / mean(rows, t, "bcq") for t in TASKS[:2]]
    assert f"between {min(shares):.1%}" in text
    assert f"and {max(shares):.1%}" in text


def test_the_summary_names_no_worst_task_where_none_failed(tmp_path: Path) -> None:
    rows = [row for row in make_rows(("reach", "lift")) if row.policy == "expert"]
    won = [replace(row, policy=p, success=True) for row in rows for p in ("expert", "bcq")]
    write_results(tmp_path / "results.csv", won)
    text = write_report(tmp_path, default_source="online", facts={}).read_text(encoding="utf-8")
    assert "solved all of 20 episodes" in text
    assert "least often" not in text


def test_a_figure_without_data_is_left_out_and_the_page_says_so(tmp_path: Path) -> None:
    write_results(tmp_path / "results.csv", make_rows())
    text = write_report(tmp_path, default_source="prototype", facts={}).read_text(encoding="utf-8")
    assert not (tmp_path / "figures").exists()
    assert "training curves is left out" in text
    assert "figures of the embedding are left out" in text
    write_curves(tmp_path, "lift", [(1, 50, 0, 10.0, 0)])
    text = write_report(tmp_path, default_source="prototype", facts={}).read_text(encoding="utf-8")
    assert "No training curve was found for Reach, Push Right" in text


def test_the_report_does_not_depend_on_the_order_of_transitions(tmp_path: Path) -> None:
    write_results(tmp_path / "results.csv", make_rows())
    data = make_embeddings()
    order = np.random.default_rng(5).permutation(len(data.task))
    pages = [
        write_report(
            tmp_path, default_source="online", facts={}, embeddings=e, training=e
        ).read_bytes()
        for e in (data, data.rows(order))
    ]
    assert pages[0] == pages[1]


def test_curves_are_grouped_by_epoch_in_order(tmp_path: Path) -> None:
    write_curves(tmp_path, "lift", [(2, 20, 0, 5.0, 1), (1, 10, 0, 1.0, 0), (1, 10, 1, 3.0, 0)])
    curves = read_stage1_curves(tmp_path, TASKS)
    assert list(curves) == ["lift"]
    assert [(e, u, r.tolist()) for e, u, r in curves["lift"]] == [
        (1, 10, [1.0, 3.0]),
        (2, 20, [5.0]),
    ]


def test_bad_input_leaves_the_old_report(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"results\.csv: contains no episode"):
        write_report(tmp_path, default_source="online", facts={})
    write_results(tmp_path / "results.csv", [])
    with pytest.raises(DataError, match="contains no episode"):
        write_report(tmp_path, default_source="online", facts={})
    write_results(tmp_path / "results.csv", make_rows())
    page = write_report(tmp_path, default_source="online", facts={})
    before = page.read_bytes()
    path = write_curves(tmp_path, "lift", [(1, 10, 0, "nan", 0)])
    with pytest.raises(DataError, match=r"evaluations\.csv: return: .*line 2 is 'nan'"):
        write_report(tmp_path, default_source="online", facts={"seed": "1"})
    assert page.read_bytes() == before
    path.write_text("epoch,episode,return\n")
    with pytest.raises(DataError, match=r"evaluations\.csv: update: column is missing"):
        write_report(tmp_path, default_source="online", facts={})


@pytest.mark.parametrize(
    ("returns", "expert", "low", "high"),
    [
        ([-5.0, -1.0], None, -5.0, 0.0),
        ([-5.0, -1.0], -20.0, -20.0, 0.0),
        ([198.0, 198.1], None, 0.0, 198.1),
        ([300.0, 310.0], 400.0, 0.0, 400.0),
    ],
)
def test_the_axes_of_curves_include_zero_and_have_a_margin_around_the_returns(
    returns: list[float],
    expert: float | None,
    low: float,
    high: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr("torchrl_bmrl.reports.figures.png", lambda figure: drawn.append(figure))
    expert_means = None if expert is None else {"still": expert}
    stage1_curves({"still": [(1, 10, np.array(returns))]}, expert_means=expert_means)
    bottom, top = drawn[0].axes[0].get_ylim()
    margin = 0.03 * (high - low)
    assert bottom == 0 if low == 0 else bottom < low - margin
    assert top == 0 if high == 0 else top > high + margin
