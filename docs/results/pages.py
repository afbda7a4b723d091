"""Parts that both pages of results share: writing and checking a page, and common sections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from comparisons import seeds_table
from published import RunRow

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.results import ResultRow, Summary
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.reports import Section, task_titles
from torchrl_bmrl.reports.paper import TABLE_1
from torchrl_bmrl.reports.report import headline
from torchrl_bmrl.reports.tables import MISSING, Table

CURVES = "images/results_curves.png"
"""The picture of the results page, below the folder of the page."""
TITLES = task_titles(TABLE_1)
"""Titles of the tasks by name."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """A page's Markdown and its picture, which is ``None`` without training curves."""

    text: str
    curves: bytes | None


def make_page(head: str, sections: Sequence[Section]) -> Page:
    """Makes a page of a text and the sections below it."""
    pictures = [picture.png for section in sections for picture in section.pictures]
    text = "\n".join([f"{head}\n", *map(_markdown, sections)])
    return Page(text=text.rstrip("\n") + "\n", curves=pictures[0] if pictures else None)


def prose(name: str) -> str:
    """Returns a text of this folder, such as ``"head"``."""
    return (Path(__file__).parent / f"{name}.txt").read_text(encoding="utf-8").rstrip()


def write_page(path: Path, page: Page) -> Path:
    """Writes a page and its picture, and returns the page's path."""
    if page.curves is not None:
        write_atomic(path.parent / CURVES, page.curves)
    write_atomic(path, page.text)
    return path


def check_page(path: Path, page: Page) -> None:
    """Checks that the page's file has this text, and that its picture exists.

    The picture is not compared, because its bytes depend on the libraries that draw it.

    Raises:
        DataError: naming the first line that differs, or the picture if it is missing.
    """
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    again = "write it with python docs/results/publish.py"
    if text != page.text:
        pairs = enumerate(zip_longest(text.split("\n"), page.text.split("\n")), start=1)
        line, (here, there) = next((line, pair) for line, pair in pairs if pair[0] != pair[1])
        message = f"line {line} is {here!r}, the CSV files give {there!r}; {again}"
        raise DataError(path, None, message)
    picture = path.parent / CURVES
    if page.curves is not None and not picture.is_file():
        raise DataError(picture, None, f"no such picture; {again}")


def in_short(
    runs: Sequence[RunRow],
    rows: Sequence[ResultRow],
    summaries: Sequence[Summary],
    targets: Table,
    *,
    source: str,
    paragraphs: Sequence[str] = (),
) -> Section:
    """Summarises the main runs of a page.

    Args:
        runs: the main runs.
        rows: their evaluated episodes.
        summaries: the means of these episodes.
        targets: table of targets, left out if it is empty.
        source: source of m of the distilled policy in the text.
        paragraphs: further paragraphs, shown after the first one.
    """
    seeds = ", ".join(str(seed) for seed in sorted({row.seed for row in rows}))
    accuracies = [run.accuracy for run in runs if run.accuracy is not None]
    accuracy = float(np.mean(accuracies)) if accuracies else None
    return Section(
        heading="In short",
        paragraphs=[
            f"Preset `{runs[0].preset}`, training seeds {seeds}; {len(rows):,} evaluated episodes.",
            *paragraphs,
            *headline(summaries, default_source=source, accuracy=accuracy),
        ],
        tables=[*([targets] if targets.rows else []), seeds_table(rows, runs)],
    )


def table_section(heading: str, *tables: Table) -> list[Section]:
    """Returns a section with the tables that have rows; none if all are empty."""
    filled = [table for table in tables if table.rows]
    return [Section(heading=heading, tables=filled)] if filled else []


def runs_sections(runs: Sequence[RunRow], *, baselines: bool, note: str = "") -> list[Section]:
    """Lists the times, commands and versions of all runs.

    Args:
        runs: the runs of the page.
        baselines: whether the page shows other algorithms.
        note: further sentences on the commands, with a space before them.
    """
    if not runs:
        return []
    more = (
        " `recipes/baselines.py` with the same settings then trains the other algorithms. With "
        "[other coefficients](baselines.md#coefficients) it needs a further folder, which the "
        "option `--baselines` adds to the page."
    )
    versions: dict[str, list[str]] = {}
    for run in runs:
        commit = f"commit {run.commit}, " if run.commit else ""
        versions.setdefault(f"{commit}{run.versions}", []).append("/".join(map(str, run.key)))
    return [
        Section(heading="Running times", tables=[_clock_table(runs)]),
        Section(
            heading="How to reproduce the runs",
            paragraphs=[
                "These commands made the runs at the commits below, where presets may have "
                "other values than today ([pipeline.md](pipeline.md)). The last ones write "
                "this page from the runs' folders." + more * baselines + note,
                "\n".join(
                    [
                        "```bash",
                        *(run.command for run in runs),
                        "python docs/results/publish.py FOLDER FOLDER",
                        "python docs/results/publish.py --check  # whether the page is up to date",
                        "```",
                    ]
                ),
                "Versions, with the runs' preset, ablation and seed:",
                "\n".join(f"- {text} ({', '.join(keys)})" for text, keys in versions.items()),
            ],
        ),
    ]


def _clock_table(runs: Sequence[RunRow]) -> Table:
    """Minutes that each stage of each run took."""

    def minutes(seconds: float | None) -> str:
        return MISSING if seconds is None else f"{seconds / 60:.1f}"

    return Table(
        title="Minutes of each stage",
        caption=(
            "Wall-clock minutes, summed over interruptions. Other work on the machine may have "
            "made a stage slower. A run with a change may link files of the run without it instead "
            "of computing them again. Workers: processes side by side, one thread each."
        ),
        header=(
            "Preset",
            "Change",
            "Seed",
            "Device",
            "Workers",
            "Demonstrations",
            "Stage 1",
            "Stage 2",
            "Evaluation",
        ),
        rows=[
            (
                run.preset,
                run.ablation,
                str(run.seed),
                run.device,
                str(run.workers),
                minutes(run.seconds_collect),
                minutes(run.seconds_stage_1),
                minutes(run.seconds_stage_2),
                minutes(run.seconds_evaluate),
            )
            for run in runs
        ],
    )


def _markdown(section: Section) -> str:
    pictures = [f"![{p.alt}]({CURVES})\n\n{p.caption}\n" for p in section.pictures]
    tables = [table.markdown(level=3) for table in section.tables]
    paragraphs = [f"{text}\n" for text in section.paragraphs]
    return "\n".join([f"## {section.heading}\n", *paragraphs, *pictures, *tables])
