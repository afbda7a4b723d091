"""Tables of the page on weak demonstrations: returns, ablations of stage 1, diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from statistics import fmean

import numpy as np
from comparisons import BCQ, arms_of, baselines_of, difference, share
from published import TASKS, WEAK_PRESETS, CurveRow, DiagnosticsRow, Published
from targets import best_source

from torchrl_bmrl.evaluation.results import ResultRow
from torchrl_bmrl.reports.tables import MISSING, Table, percent, task_name
from torchrl_bmrl.studies.baselines_report import make_paired_table, make_table

Change = tuple[str, str]
"""Preset and ablation."""
PUSHES = tuple(task for task in TASKS if task.startswith("push"))
RETURN_LIMITS = (250, 300, 350, 400)
"""Limits between the intervals of :func:`pushes_table`."""


def returns_table(rows: Sequence[ResultRow], titles: dict[str, str]) -> Table:
    """Mean return and success of every policy and task."""
    return replace(
        make_table(rows, 0, titles),
        title="Returns and success",
        caption=(
            "Mean return of an episode, and success, on the same starts. The brackets after "
            "Distilled contain the source of m. Expert and scripted optimum are scripted; the "
            "other policies learn from the same demonstrations. [baselines.md](baselines.md) "
            "describes the other algorithms. The brackets after their names contain the "
            "coefficients that were [tuned](baselines.md#tuned-for-weak-demonstrations). 95% "
            "interval: that of the success on all tasks, by a "
            "bootstrap over the episodes of each task."
        ),
    )


def stages_table(rows: Sequence[ResultRow], titles: dict[str, str]) -> Table:
    """Both stages minus every other algorithm, start by start."""
    stages = [arm for arm in (BCQ, best_source(rows)) if arm in arms_of(rows)]
    others = [name for name, _ in baselines_of(rows)]
    return replace(
        make_paired_table(rows, titles, policies=stages, references=others),
        title="Both stages minus each other algorithm",
        caption=(
            "As in the table above. Distilled: with the source of m of the targets. Intervals that "
            "contain 0 do not tell which policy returns more."
        ),
    )


def pushes_table(rows: Sequence[ResultRow]) -> Table:
    """Counts the push episodes of both stages by their return, and their successes."""
    pushes = [row for row in rows if row.task in PUSHES]
    lines = []
    for low, high in pairwise((-np.inf, *RETURN_LIMITS, np.inf)):
        cells = []
        for policy in ("expert", "bcq", "distilled"):
            solved = [
                bool(row.success)
                for row in pushes
                if row.policy == policy and low <= row.episode_return < high
            ]
            cells.append(f"{len(solved)} ({percent(fmean(solved))})" if solved else "0")
        lines.append((_interval(low, high), *cells))
    return Table(
        title="Pushes by return",
        caption=(
            "Number of the pushes' episodes whose return is in the interval, and the share of "
            "these that succeeded. Distilled: all sources of m that were evaluated."
        ),
        header=("Return", "Expert", "BCQ", "Distilled"),
        rows=lines if pushes else [],
    )


def steps_table(published: Published) -> Table:
    """Compares ablations of stage 1 with the runs of the same preset without an ablation."""
    lines, starts = [], {}
    for preset in WEAK_PRESETS:
        changes = list(dict.fromkeys(r.key[:2] for r in published.runs if r.preset == preset))
        if not any(ablation != "none" for _, ablation in changes):
            continue
        evaluated = {change: _evaluated(published, change) for change in changes}
        # One kind of starts for all lines of a preset, so that they can be compared.
        if all(evaluated.values()):
            kind, found = "those of the evaluation", evaluated
        else:
            kind = "those of the rollouts after each epoch of stage 1, here after the last"
            found = {change: _rolled_out(published.curves, change) for change in changes}
        starts[preset] = kind
        base = found.get((preset, "none"), [])
        lines += [_step(change, rows, base) for change, rows in found.items() if rows]
    kinds = "; ".join(f"for preset {preset}, {kind}" for preset, kind in starts.items())
    return Table(
        title="Presets with and without a change",
        caption=(
            "Each line except “none” is an ablation of the preset (`recipes/config/ablation`). "
            "Cells: mean return and success of BCQ. Share: the mean return divided by that "
            "without the change, from the same starts and seeds, as a mean over tasks; the 95% "
            "interval resamples pairs of episodes within each task and seed. Starts, which no "
            f"demonstration had: {kinds}. Episodes: of each task and seed."
        ),
        header=("Change", "Preset", *map(task_name, TASKS), "Share", "Seeds", "Episodes"),
        rows=lines,
    )


def agents_table(rows: Sequence[DiagnosticsRow]) -> Table:
    """The last diagnostics of every run's agents."""
    runs = {row.key: {r.task: r for r in rows if r.key == row.key} for row in rows}
    return Table(
        title="Candidates and critics",
        caption=(
            "After the last epoch of stage 1, on training demonstrations. Change: the ablation. "
            "Cells: spread ratio, value gap, outside share ([diagnostics.md](diagnostics.md)). "
            "Spread ratio: the spread of the candidates divided by that of the demonstrated "
            "actions; 1 if the generator models the demonstrations, near 0 if the policy clones "
            "them. Value gap: the critics' value of the chosen action minus that of the "
            "demonstrated one, in standard deviations of the latter. Outside share: share of the "
            "chosen actions that are farther from the candidates' mean than 99% of the "
            "demonstrated ones."
        ),
        header=("Change", "Preset", "Seed", *map(task_name, TASKS)),
        rows=[
            (key[1], key[0], str(key[2]), *(_agent(agents.get(task)) for task in TASKS))
            for key, agents in runs.items()
        ],
    )


def _interval(low: float, high: float) -> str:
    if low == -np.inf:
        return f"below {high:g}"
    return f"{low:g} or more" if high == np.inf else f"{low:g} to {high:g}"


def _evaluated(published: Published, change: Change) -> list[ResultRow]:
    """Returns BCQ's evaluated episodes; none if a run of the change has no evaluation."""
    rows = [e for e in published.episodes if (e.preset, e.ablation) == change]
    rows = [e for e in rows if (e.row.policy, e.row.latent_source) == BCQ]
    runs = {run.key for run in published.runs if run.key[:2] == change}
    return [e.row for e in rows] if {e.key for e in rows} == runs else []


def _rolled_out(curves: Sequence[CurveRow], change: Change) -> list[ResultRow]:
    """Returns the rollouts of a change, all after the last epoch, as episodes of BCQ."""
    return [
        ResultRow(
            task=c.task,
            policy=BCQ[0],
            seed=c.seed,
            episode=c.episode,
            episode_return=c.episode_return,
            success=c.success,
        )
        for c in curves
        if c.key[:2] == change
    ]


def _step(change: Change, rows: Sequence[ResultRow], base: Sequence[ResultRow]) -> tuple[str, ...]:
    cells = []
    for task in TASKS:
        mine = [row for row in rows if row.task == task]
        mean = np.mean([row.episode_return for row in mine]) if mine else 0.0
        rate = np.mean([bool(row.success) for row in mine]) if mine else 0.0
        cells.append(f"{mean:.1f} ({percent(float(rate))})" if mine else MISSING)
    tasks = [task for task in TASKS if any(row.task == task for row in rows)]
    gain = difference(rows, base, BCQ, BCQ, tasks) if change[1] != "none" else None
    seeds = ", ".join(map(str, sorted({row.seed for row in rows})))
    episodes = len({row.episode for row in rows})
    whole = MISSING if gain is None else share(gain)
    return change[1], change[0], *cells, whole, seeds, str(episodes)


def _agent(row: DiagnosticsRow | None) -> str:
    if row is None:
        return MISSING
    gap = MISSING if row.relative_gap is None else f"{row.relative_gap:+.2f}"
    return f"{row.spread_ratio:.2f}, {gap}, {percent(row.outside_share)}"
