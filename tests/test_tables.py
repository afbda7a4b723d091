"""Tables are recomputed from the rows; their Markdown, HTML and CSV have the same cells."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import csv
import io
import re

import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from report_data import ARMS, TASKS, TITLES, cells, make_rows, mean

from torchrl_bmrl.evaluation import summarise
from torchrl_bmrl.reports import Table, paper, results_table, table_1, table_2


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
        "| &lt;b> | [2, 3] |",
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
