"""The page on weak demonstrations in Markdown, computed from the CSV files of its runs alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from comparisons import (
    BCQ,
    DEFAULT_SOURCE,
    EXPERT,
    REFERENCE,
    baselines_of,
    difference,
    differences,
    share,
)
from pages import (
    TITLES,
    Page,
    check_page,
    in_short,
    make_page,
    prose,
    runs_sections,
    table_section,
    write_page,
)
from published import TASKS, WEAK, Published, RunRow, read_published
from targets import best_source, weak_targets_table
from weak_tables import agents_table, pushes_table, returns_table, stages_table, steps_table

from torchrl_bmrl.evaluation.results import ResultRow, Summary, summarise
from torchrl_bmrl.reports import Section, results_table, task_name
from torchrl_bmrl.reports.tables import Table
from torchrl_bmrl.studies.baselines_report import make_paired_table

NOTE = (
    " Before the first line with `recipes/train_bcq.py`, record its demonstrations once: with "
    "`recipes/collect.py`, the same preset, seed and tasks, and `run_dir=runs/weak`. Then add "
    "`base=runs/weak` to each of these lines, and a `run_dir` of its own."
)


def make_weak_page(published: Published) -> Page:
    """Makes the page; a section without data is left out."""
    rows = [e.row for e in published.episodes if e.key[:2] == WEAK]
    runs = [run for run in published.runs if run.key[:2] == WEAK]
    summaries = summarise(rows, TASKS)
    steps, agents = steps_table(published), agents_table(published.diagnostics)
    alone = not all(run.evaluated for run in published.runs)
    sections = [
        *_main_sections(rows, summaries, runs),
        *_ablations(steps),
        *table_section("Diagnostics of stage 1", agents),
        Section(heading="How the settings were chosen", paragraphs=[prose("weak_tried")]),
        *runs_sections(
            published.runs, baselines=bool(baselines_of(rows)), note=NOTE if alone else ""
        ),
    ]
    if summaries:
        sections += table_section("Everything measured", results_table(summaries))
    return make_page(prose("weak_head"), sections)


def write_weak_page(folder: Path) -> Path | None:
    """Writes ``weak.md`` into ``folder`` from the CSV files in its ``results/weak``.

    Returns:
        path of the page; ``None``, and nothing is written, without published runs.

    Raises:
        DataError: if a CSV file is not valid.
    """
    published = read_published(folder / "results" / "weak")
    return write_page(folder / "weak.md", make_weak_page(published)) if published.runs else None


def check_weak_page(folder: Path) -> None:
    """Checks that ``weak.md`` is what the CSV files give, if runs are published.

    Raises:
        DataError: naming the first line that differs.
    """
    published = read_published(folder / "results" / "weak")
    if published.runs:
        check_page(folder / "weak.md", make_weak_page(published))


def _ablations(steps: Table) -> list[Section]:
    """The table of ablations below what it shows."""
    sections = table_section("Ablations of stage 1", steps)
    return [replace(section, paragraphs=[prose("weak_ablations")]) for section in sections]


def _main_sections(
    rows: Sequence[ResultRow], summaries: Sequence[Summary], runs: Sequence[RunRow]
) -> list[Section]:
    """Sections on the main runs."""
    if not rows:
        return []
    targets = weak_targets_table(rows, summaries)
    source = best_source(rows)
    return [
        in_short(
            runs,
            rows,
            summaries,
            targets,
            source=source[1] if source else DEFAULT_SOURCE,
            paragraphs=_short(rows, targets),
        ),
        Section(heading="Every policy and task", tables=[returns_table(rows, TITLES)]),
        *table_section(
            "Paired differences", make_paired_table(rows, TITLES), stages_table(rows, TITLES)
        ),
        *table_section("Where the pushes fall short", pushes_table(rows)),
    ]


def _short(rows: Sequence[ResultRow], targets: Table) -> list[str]:
    """Summarises the gain over the expert, and which targets are met."""
    sentences = []
    if gains := differences(rows, BCQ, EXPERT):
        each = sorted(gains.items(), key=lambda item: item[1].value)
        low, high = (f"{1 + g.value:.0%} ({task_name(task)})" for task, g in (each[0], each[-1]))
        sentences.append(
            f"The BCQ policies return between {low} and {high} of what their demonstrators return."
        )
    best = difference(rows, rows, BCQ, REFERENCE)
    if best is not None:
        sentences.append(
            f"On the mean over tasks they return {share(best)} "
            "of what the scripted optimum returns."
        )
    if targets.rows:
        missed = [what for what, _, _, met in targets.rows if met == "no"]
        met = f"{len(targets.rows) - len(missed)} of {len(targets.rows)} targets are met"
        short = "".join(f"\n- {each}" for each in missed)
        sentences.append(f"{met}. Not met:\n{short}" if missed else f"{met}.")
    return [" ".join(sentences)] if sentences else []
