"""The results page in Markdown, computed from the three CSV files alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from comparisons import (
    BCQ,
    DEFAULT_SOURCE,
    DISTILLED,
    EXPERT,
    Arm,
    ablations_table,
    arms_of,
    differences,
    differences_table,
    gains_table,
    policies_table,
    seeds_table,
    spread_table,
    targets_table,
)
from published import MAIN, TASKS, CurveRow, Published, RunRow, read_published

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.results import ResultRow, Summary, summarise
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.reports import Picture, Section, paper, results_table, stage1_curves, task_titles
from torchrl_bmrl.reports.figures import Curve
from torchrl_bmrl.reports.report import headline
from torchrl_bmrl.reports.tables import MISSING, Table, policy_name

CURVES = "images/results_curves.png"
"""The picture, below the folder of the page."""
_TITLES = task_titles(TASKS)
_HEAD, _RETURNS, _TRIED = (
    (Path(__file__).parent / f"{name}.txt").read_text(encoding="utf-8")
    for name in ("head", "returns", "tried")
)


@dataclass(frozen=True, kw_only=True)
class ResultsPage:
    """The page's Markdown and its picture, which is ``None`` without training curves."""

    text: str
    curves: bytes | None


def make_results_page(published: Published) -> ResultsPage:
    """Makes the page; a section without data is left out."""
    rows = [e.row for e in published.episodes if e.key[:2] == MAIN]
    runs = [run for run in published.runs if run.key[:2] == MAIN]
    summaries = summarise(rows, TASKS)
    sections = [
        *_main_sections(rows, summaries, runs, published.curves),
        *_ablations(published),
        *_runs(published.runs, baselines=bool(_baselines(rows))),
        Section(heading="Why returns differ from the paper's", paragraphs=[_RETURNS.rstrip()]),
        Section(heading="What was tried", paragraphs=[_TRIED.rstrip()]),
    ]
    if summaries:
        sections.append(Section(heading="Everything measured", tables=[results_table(summaries)]))
    pictures = [picture.png for section in sections for picture in section.pictures]
    text = "\n".join([_HEAD, *map(_markdown, sections)])
    return ResultsPage(text=text.rstrip("\n") + "\n", curves=pictures[0] if pictures else None)


def write_results_page(folder: Path) -> Path:
    """Writes ``results.md`` and its picture into ``folder`` from the CSV files in its ``results``.

    Raises:
        DataError: if a CSV file is not valid.
    """
    page = make_results_page(read_published(folder / "results"))
    if page.curves is not None:
        write_atomic(folder / CURVES, page.curves)
    write_atomic(folder / "results.md", page.text)
    return folder / "results.md"


def check_results_page(folder: Path) -> None:
    """Checks that ``results.md`` is what the CSV files give, and that its picture exists.

    The picture is not compared, because its bytes depend on the libraries that draw it.

    Raises:
        DataError: naming the first line that differs, or the picture if it is missing.
    """
    path = folder / "results.md"
    page = make_results_page(read_published(folder / "results"))
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    again = "write it with python docs/results/publish.py"
    if text != page.text:
        pairs = enumerate(zip_longest(text.split("\n"), page.text.split("\n")), start=1)
        line, (here, there) = next((line, pair) for line, pair in pairs if pair[0] != pair[1])
        message = f"line {line} is {here!r}, the CSV files give {there!r}; {again}"
        raise DataError(path, None, message)
    if page.curves is not None and not (folder / CURVES).is_file():
        raise DataError(folder / CURVES, None, f"no such picture; {again}")


def _main_sections(
    rows: Sequence[ResultRow],
    summaries: Sequence[Summary],
    runs: Sequence[RunRow],
    curves: Sequence[CurveRow],
) -> list[Section]:
    """Sections on the runs with the paper's sizes."""
    if not rows:
        return []
    accuracies = [run.accuracy for run in runs if run.accuracy is not None]
    seeds = ", ".join(str(seed) for seed in sorted({row.seed for row in rows}))
    episodes = len(rows)
    targets = targets_table(rows, summaries, runs)
    drawn = _curves(curves)
    sections = [
        Section(
            heading="In short",
            paragraphs=[
                f"Preset `{MAIN[0]}`, training seeds {seeds}; {episodes:,} evaluated episodes.",
                *headline(
                    summaries,
                    default_source=DEFAULT_SOURCE,
                    accuracy=float(np.mean(accuracies)) if accuracies else None,
                ),
            ],
            tables=[*([targets] if targets.rows else []), seeds_table(rows, runs)],
        ),
        Section(
            heading="The paper's tables",
            tables=[
                paper.table_1(
                    summaries,
                    titles=_TITLES,
                    epochs={task: curve[-1][0] for task, curve in drawn.items()},
                    differences=differences(rows, BCQ, EXPERT),
                ),
                paper.table_2(
                    [s for s in summaries if s.latent_source in ("", DEFAULT_SOURCE)],
                    titles=_TITLES,
                    default_source=DEFAULT_SOURCE,
                    differences=differences(rows, DISTILLED, BCQ),
                ),
            ],
        ),
        _over_the_expert(rows),
        _sources(rows, summaries),
        _figure_3(drawn, summaries),
        _stages(rows, summaries),
    ]
    return [section for section in sections if section.tables or section.paragraphs]


def _over_the_expert(rows: Sequence[ResultRow]) -> Section:
    table = differences_table(rows, [BCQ, DISTILLED])
    return Section(heading="Over the expert", tables=[table] if table.rows else [])


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


def _baselines(rows: Sequence[ResultRow]) -> list[Arm]:
    return [arm for arm in arms_of(rows) if arm[0] not in ("expert", "bcq", "distilled")]


def _stages(rows: Sequence[ResultRow], summaries: Sequence[Summary]) -> Section:
    """Compares with other algorithms on the same demonstrations, if there are any."""
    baselines = _baselines(rows)
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
                    "All learn from the same demonstrations. BC, TD3+BC, IQL and CQL are "
                    "TorchRL's losses, one policy for each task as BCQ; BCQ with a one-hot task "
                    "is one policy for all tasks, trained at once and told the task's index."
                ),
            ),
            *([gains] if gains.rows else []),
        ],
    )


def _ablations(published: Published) -> list[Section]:
    table = ablations_table(published.episodes, published.runs)
    return [Section(heading="Ablations", tables=[table])] if table.rows else []


def _runs(runs: Sequence[RunRow], *, baselines: bool) -> list[Section]:
    """Lists the times, commands and versions of all runs."""
    if not runs:
        return []
    more = " The other algorithms: the same settings with `recipes/baselines.py`, afterwards."
    versions: dict[str, list[str]] = {}
    for run in runs:
        commit = f"commit {run.commit}, " if run.commit else ""
        versions.setdefault(f"{commit}{run.versions}", []).append("/".join(map(str, run.key)))
    return [
        Section(heading="How long it took", tables=[_clock_table(runs)]),
        Section(
            heading="Again",
            paragraphs=[
                "The same runs, and then this page from their folders." + more * baselines,
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
            "Wall-clock minutes, summed over interruptions, with what else the machine did at the "
            "time. A run with a change may take over what it would only make again from the run "
            "without it. Workers: processes side by side, one thread each."
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
