"""The report stands alone, summarises the rows, and names what it could not measure."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from report_data import TASKS, TITLES, make_embeddings, make_known, make_rows, mean

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation import write_results
from torchrl_bmrl.reports import (
    Embeddings,
    Section,
    Table,
    read_stage1_curves,
    write_page,
    write_report,
)

TABLES = ("results", "table1", "table2", "stages", "goal_distance")


def write_curves(run_dir: Path, task: str, rows: list[tuple[object, ...]]) -> Path:
    path = run_dir / "bcq" / task / "evaluations.csv"
    path.parent.mkdir(parents=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("epoch", "update", "episode", "return", "success"), *rows])
    return path


class Resources(HTMLParser):
    """Everything that the page makes a browser load, and the names of its elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]


def test_the_report_says_what_it_could_not_measure(tmp_path: Path) -> None:
    write_results(tmp_path / "results.csv", make_rows())
    data = replace(make_known(), phase_names={}, success=np.zeros(144, dtype=bool))
    page = write_report(
        tmp_path, default_source="online", facts={}, embeddings=data, training=data
    ).read_text(encoding="utf-8")
    assert "stages are left out: no phases" in page
    assert "distances are left out: no training demonstration succeeds" in page
    assert {p.stem for p in (tmp_path / "tables").iterdir()} == {"results", "table1", "table2"}


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
    """Twelve tasks with recorded data only: no episodes, phases, goals or successes."""
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
    assert "90.0% of the cases." in text  # not the paper's number
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
        mine = [r for r in rows if (r.policy, r.latent_source) == (policy, source)]
        solved = {task: sum(r.success for r in mine if r.task == task) for task in TASKS[:2]}
        worst = min(TASKS[:2], key=solved.__getitem__)
        assert (
            f"solved {sum(solved.values())} of 20 episodes "
            f"(least often on {TITLES[worst]}: {solved[worst] / 10:.0%})"
        ) in text
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
    assert text.count("are left out") == 1
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
