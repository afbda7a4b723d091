"""The results page in Markdown, computed from the CSV files of its runs alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from comparisons import (
    BCQ,
    DEFAULT_SOURCE,
    DISTILLED,
    EXPERT,
    ablations_table,
    arms_of,
    baselines_of,
    differences,
    differences_table,
    gains_table,
    policies_table,
    spread_table,
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
from published import (
    MAIN,
    TASKS,
    CurveRow,
    Published,
    RunRow,
    read_published,
)
from targets import targets_table

from torchrl_bmrl.evaluation.results import ResultRow, Summary, summarise
from torchrl_bmrl.reports import Picture, Section, paper, results_table, stage1_curves
from torchrl_bmrl.reports.figures import Curve
from torchrl_bmrl.reports.tables import policy_name


def make_results_page(published: Published) -> Page:
    """Makes the page; a section without data is left out."""
    rows = [e.row for e in published.episodes if e.key[:2] == MAIN]
    runs = [run for run in published.runs if run.key[:2] == MAIN]
    curves = [curve for curve in published.curves if curve.key[:2] == MAIN]
    summaries = summarise(rows, TASKS)
    sections = [
        *_main_sections(rows, summaries, runs, curves),
        *table_section("Ablations", ablations_table(published.episodes, published.runs)),
        *runs_sections(published.runs, baselines=bool(baselines_of(rows))),
        Section(heading="Why returns differ from the paper's", paragraphs=[prose("returns")]),
        Section(heading="What was tried", paragraphs=[prose("tried")]),
    ]
    if summaries:
        sections += table_section("Everything measured", results_table(summaries))
    return make_page(prose("head"), sections)


def write_results_page(folder: Path) -> Path:
    """Writes ``results.md`` and its picture into ``folder`` from the CSV files in its ``results``.

    Raises:
        DataError: if a CSV file is not valid.
    """
    return write_page(folder / "results.md", make_results_page(read_published(folder / "results")))


def check_results_page(folder: Path) -> None:
    """Checks that ``results.md`` is what the CSV files give, and that its picture exists.

    Raises:
        DataError: naming the first line that differs, or the picture if it is missing.
    """
    check_page(folder / "results.md", make_results_page(read_published(folder / "results")))


def _main_sections(
    rows: Sequence[ResultRow],
    summaries: Sequence[Summary],
    runs: Sequence[RunRow],
    curves: Sequence[CurveRow],
) -> list[Section]:
    """Sections on the runs with the paper's sizes."""
    if not rows:
        return []
    targets = targets_table(rows, summaries, runs)
    drawn = _curves(curves)
    sections = [
        in_short(runs, rows, summaries, targets, source=DEFAULT_SOURCE),
        Section(
            heading="The paper's tables",
            tables=[
                paper.table_1(
                    summaries,
                    titles=TITLES,
                    epochs={task: curve[-1][0] for task, curve in drawn.items()},
                    differences=differences(rows, BCQ, EXPERT),
                ),
                paper.table_2(
                    [s for s in summaries if s.latent_source in ("", DEFAULT_SOURCE)],
                    titles=TITLES,
                    default_source=DEFAULT_SOURCE,
                    differences=differences(rows, DISTILLED, BCQ),
                ),
            ],
        ),
        *table_section("Over the expert", differences_table(rows, [BCQ, DISTILLED])),
        _sources(rows, summaries),
        _figure_3(drawn, summaries),
        _stages(rows, summaries),
    ]
    return [section for section in sections if section.tables or section.paragraphs]


def _sources(rows: Sequence[ResultRow], summaries: Sequence[Summary]) -> Section:
    """Compares the sources of m, if the distilled policy was evaluated with more than one."""
    arms = {
        arm: f"{arm[1]} (default)" if arm == DISTILLED else arm[1]
        for arm in arms_of(rows)
        if arm[0] == "distilled"
    }
    if len(arms) < 2:
        return Section(heading="")
    return Section(
        heading="Where m comes from",
        tables=[
            policies_table(
                rows,
                summaries,
                arms,
                BCQ,
                title="The distilled policy by its source of m",
                caption=(
                    "Prototype: one fixed point for each task. Online: the embedding of the last "
                    "transition. Demonstration: the embeddings of one held-out demonstration."
                ),
            )
        ],
    )


def _curves(rows: Sequence[CurveRow]) -> dict[str, Curve]:
    """Collects the returns by task and epoch, the episodes of all seeds together."""
    found: dict[str, dict[tuple[int, int], list[float]]] = {}
    for row in rows:
        epochs = found.setdefault(row.task, {})
        epochs.setdefault((row.epoch, row.update), []).append(row.episode_return)
    return {
        task: [(*epoch, np.array(epochs[epoch])) for epoch in sorted(epochs)]
        for task, epochs in sorted(found.items(), key=lambda item: TASKS.index(item[0]))
    }


def _figure_3(curves: dict[str, Curve], summaries: Sequence[Summary]) -> Section:
    if not curves:
        return Section(heading="")
    experts = {s.task: s.mean_return for s in summaries if s.policy == "expert"}
    return Section(
        heading="The paper's figure 3",
        tables=[spread_table(curves)],
        pictures=[
            Picture(
                png=stage1_curves(curves, expert_means=experts),
                alt="Return of BCQ against training epoch, one panel per task",
                caption=(
                    "Return of the BCQ policy, rolled out after each epoch of stage 1: mean, and "
                    "a band of one standard deviation over episodes and seeds to either side. "
                    "Dashed: mean return of the expert. The paper shows the pushes."
                ),
            )
        ],
    )


def _stages(rows: Sequence[ResultRow], summaries: Sequence[Summary]) -> Section:
    """Compares with other algorithms on the same demonstrations, if there are any."""
    baselines = baselines_of(rows)
    if not baselines:
        return Section(heading="")
    present = [arm for arm in (BCQ, DISTILLED) if arm in arms_of(rows)]
    pairs = [
        (BCQ, EXPERT),
        *((BCQ, arm) for arm in baselines if arm[0] != "bcq_one_hot"),
        (DISTILLED, BCQ),
        *((DISTILLED, arm) for arm in baselines if arm[0] == "bcq_one_hot"),
    ]
    gains = gains_table(rows, pairs)
    return Section(
        heading="Beside other algorithms",
        tables=[
            policies_table(
                rows,
                summaries,
                {arm: policy_name(arm[0]) for arm in (*present, *baselines)},
                EXPERT,
                title="Policies and tasks",
                caption=(
                    "All learn from the same demonstrations. BC, TD3+BC and IQL are TorchRL's "
                    "losses, with one policy per task as BCQ has; BCQ with a one-hot task "
                    "is one policy for all tasks, trained at once and told the task's index."
                ),
            ),
            *([gains] if gains.rows else []),
        ],
    )
