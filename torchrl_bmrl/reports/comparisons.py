"""Policies and runs beside each other, as tables computed from published episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_bmrl.evaluation.results import POLICIES, ResultRow, Summary
from torchrl_bmrl.evaluation.statistics import (
    Estimate,
    probability_of_improvement,
    relative_difference,
)
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports import paper
from torchrl_bmrl.reports.figures import Curve
from torchrl_bmrl.reports.published import EpisodeRow, RunRow
from torchrl_bmrl.reports.tables import MISSING, Table, policy_name, task_name

DEFAULT_SOURCE = "prototype"
"""Source of m that the distilled policy acts with unless it is told another."""

Arm = tuple[str, str]
"""A policy and its source of m, which is empty for all but the distilled one."""

EXPERT: Arm = ("expert", "")
BCQ: Arm = ("bcq", "")
DISTILLED: Arm = ("distilled", DEFAULT_SOURCE)


@dataclass(frozen=True, kw_only=True)
class Target:
    """The least that is asked of a policy.

    Attributes:
        what: what is measured, in words.
        least: what is asked for, in [-1, 1].
        measured: number, and in brackets its interval or where it was measured; the lowest task's.
        value: the number that has to reach ``least``.
    """

    what: str
    least: float
    measured: str
    value: float


def difference(
    ours: Iterable[ResultRow],
    theirs: Iterable[ResultRow],
    x: Arm,
    y: Arm,
    tasks: Sequence[str] = TASKS,
) -> Estimate | None:
    """Relative difference of mean returns on the same starts; over several tasks, its mean.

    Episodes are paired by task, training seed and number, and resampled in pairs within each task
    and seed.

    Args:
        ours: episodes that those of ``x`` are taken from.
        theirs: episodes that those of ``y`` are taken from.
        x: the one policy.
        y: the other.
        tasks: those to compare on.

    Returns:
        Difference and 95% interval; ``None`` if the two share no episode on one of the tasks, or
        the mean return of ``y`` is not positive on one: there are no shares of it.

    Example:
        >>> rows = [
        ...     ResultRow(task="lift", policy=p, seed=1, episode=0, episode_return=r, success=True)
        ...     for p, r in (("expert", 100.0), ("bcq", 101.0))
        ... ]
        >>> difference(rows, rows, BCQ, EXPERT, ["lift"]).value
        0.01
    """
    one, other = _returns(ours, x, tasks), _returns(theirs, y, tasks)
    shared = sorted(one.keys() & other.keys())
    if not shared or {task for task, _, _ in shared} != set(tasks):
        return None
    totals: dict[str, float] = dict.fromkeys(tasks, 0.0)
    for key in shared:
        totals[key[0]] += other[key]
    if min(totals.values()) <= 0.0:
        return None
    return relative_difference(
        [one[key] for key in shared],
        [other[key] for key in shared],
        strata=[seed for _, seed, _ in shared],
        groups=[task for task, _, _ in shared],
    )


def improvement(
    rows: Iterable[ResultRow], x: Arm, y: Arm, tasks: Sequence[str] = TASKS
) -> Estimate | None:
    """Probability of improvement; over several tasks, its mean over tasks.

    Args:
        rows: episodes.
        x: the one policy.
        y: the other.
        tasks: those to compare on.

    Returns:
        Probability and 95% interval; ``None`` if tasks or seeds of the two differ.
    """
    rows = list(rows)
    values = [_returns(rows, arm, tasks) for arm in (x, y)]
    strata = [[f"{task}/{seed}" for task, seed, _ in value] for value in values]
    if set(strata[0]) != set(strata[1]) or {task for task, _, _ in values[0]} != set(tasks):
        return None
    return probability_of_improvement(
        list(values[0].values()),
        list(values[1].values()),
        x_strata=strata[0],
        y_strata=strata[1],
    )


def targets(
    rows: Sequence[ResultRow], summaries: Sequence[Summary], runs: Sequence[RunRow]
) -> list[Target]:
    """What is asked of the two stages, each on the task that fares worst.

    What was not measured on every task is left out.

    Args:
        rows: episodes.
        summaries: their summaries.
        runs: the runs that they are of.
    """
    found = []
    if gains := _by_task(rows, BCQ, EXPERT):
        task, estimate = min(gains.items(), key=lambda item: item[1].low)
        found.append(
            Target(
                what="BCQ over the expert: lower end of the interval of the relative difference",
                least=-0.02,
                measured=f"{estimate.low:+.1%} ({task_name(task)}: {_signed(estimate)})",
                value=estimate.low,
            )
        )
    found += _success_target("BCQ", BCQ, summaries)
    if gains := _by_task(rows, DISTILLED, BCQ):
        task, estimate = min(gains.items(), key=lambda item: item[1].value)
        found.append(
            Target(
                what="Distilled: return as a share of BCQ's",
                least=0.98,
                measured=f"{1 + estimate.value:.1%} ({task_name(task)}: {_share(estimate)})",
                value=1 + estimate.value,
            )
        )
    found += _success_target("Distilled", DISTILLED, summaries)
    accuracies = [(run.accuracy, run.seed) for run in runs if run.accuracy is not None]
    if accuracies:
        accuracy, seed = min(accuracies)
        found.append(
            Target(
                what="Accuracy of the task classifier on held-out transitions",
                least=paper.ACCURACY,
                measured=f"{accuracy:.1%} (seed {seed})",
                value=accuracy,
            )
        )
    return found


def targets_table(found: Sequence[Target]) -> Table:
    """What was asked, what was measured, whether it is met.

    Example:
        >>> targets_table([Target(what="A", least=0.95, measured="96%", value=0.96)]).rows
        [('A', 'at least 95%', '96%', 'yes')]
    """
    return Table(
        title="What was asked for",
        caption=(
            "Each number is that of the task, or of the seed, that fares worst; the interval "
            f"beside it is that task's. Distilled: with the default source of m, {DEFAULT_SOURCE}."
        ),
        header=("What", "Asked", "Measured", "Met"),
        rows=[
            (t.what, f"at least {t.least:.0%}", t.measured, "yes" if t.value >= t.least else "no")
            for t in found
        ],
    )


def seeds_table(rows: Sequence[ResultRow], runs: Sequence[RunRow]) -> Table:
    """The same by training seed: how far one training differs from another.

    Args:
        rows: episodes.
        runs: the runs that they are of.
    """
    lines = []
    for run in runs:
        mine = [row for row in rows if row.seed == run.seed]
        gains = (difference(mine, mine, BCQ, EXPERT), difference(mine, mine, DISTILLED, BCQ))
        lines.append(
            (
                str(run.seed),
                *(MISSING if gain is None else _share(gain) for gain in gains),
                *(_success_rate(mine, arm, TASKS) for arm in (BCQ, DISTILLED)),
                MISSING if run.accuracy is None else f"{run.accuracy:.1%}",
            )
        )
    return Table(
        title="By training seed",
        caption=(
            "Every seed has its own demonstrations, agents and distilled policy. Mean over tasks "
            "of the mean return as a share of the other policy's on the same starts, with a 95% "
            "interval; success over the episodes of all tasks."
        ),
        header=(
            "Seed",
            "BCQ / expert",
            "Distilled / BCQ",
            "Success of BCQ",
            "Success of distilled",
            "Accuracy",
        ),
        rows=lines,
    )


def differences_table(rows: Sequence[ResultRow], arms: Sequence[Arm], reference: Arm) -> Table:
    """Relative difference and probability of improvement of policies over one, task by task.

    Args:
        rows: episodes.
        arms: policies.
        reference: the one that they are put beside.
    """
    lines = []
    for arm in arms:
        for tasks in (*([task] for task in TASKS), TASKS):
            gain = difference(rows, rows, arm, reference, tasks)
            chance = improvement(rows, arm, reference, tasks)
            if gain is not None:
                name = task_name(tasks[0]) if len(tasks) == 1 else "Mean over tasks"
                lines.append((policy_name(arm[0]), name, _signed(gain), _probability(chance)))
    name = policy_name(reference[0]).lower()
    return Table(
        title=f"Difference to the {name}, and probability of improvement",
        caption=(
            f"Relative difference: mean return of the policy less that of the {name}, over that of "
            f"the {name}. Both act from the same starts, so episodes are resampled in pairs, "
            "within each training seed. Probability of improvement P(X > Y): how often an episode "
            f"of the policy returns more than an episode of the {name} of the same seed, over all "
            "pairs, a tie counting half; 50% is no difference. Its interval resamples the "
            "episodes of both independently within each seed (Agarwal et al. 2021). Brackets hold "
            "95% intervals."
        ),
        header=("Policy", "Task", "Relative difference", "P(X > Y)"),
        rows=lines,
    )


def policies_table(
    rows: Sequence[ResultRow],
    summaries: Sequence[Summary],
    arms: Mapping[Arm, str],
    reference: Arm,
    *,
    title: str,
    caption: str,
) -> Table:
    """Policies by tasks: return as a share of one policy's, and success.

    Args:
        rows: episodes.
        summaries: their summaries.
        arms: name of each line's policy.
        reference: the policy that the returns are shares of.
        title: of the table.
        caption: what a reader must know besides what the cells are.
    """
    success = {(s.task, s.policy, s.latent_source): s.success_rate for s in summaries}
    whose = "the expert's" if reference == EXPERT else f"{policy_name(reference[0])}'s"
    lines = []
    for arm, name in arms.items():
        cells = []
        for task in TASKS:
            gain = difference(rows, rows, arm, reference, [task])
            rate = success.get((task, *arm))
            share = MISSING if gain is None else f"{1 + gain.value:.1%}"
            cells.append(MISSING if rate is None else f"{share} ({rate:.0%})")
        mean = difference(rows, rows, arm, reference)
        seeds = sorted({row.seed for row in rows if (row.policy, row.latent_source) == arm})
        mean_share = MISSING if mean is None else _share(mean)
        lines.append((name, *cells, mean_share, ", ".join(map(str, seeds))))
    return Table(
        title=title,
        caption=(
            f"{caption} Cells: mean return as a share of {whose} on the "
            "same starts, and in parentheses the success rate. Mean over tasks: of the shares, "
            "with its 95% interval, episodes resampled in pairs within each task and seed. Seeds: "
            "of the training; policies are compared on the starts of those that they share."
        ),
        header=("Policy", *map(task_name, TASKS), "Mean over tasks", "Seeds"),
        rows=lines,
    )


def gains_table(rows: Sequence[ResultRow], pairs: Sequence[tuple[Arm, Arm]]) -> Table:
    """What one policy has over another, for several pairs of policies.

    Args:
        rows: episodes.
        pairs: two policies each.
    """
    lines = []
    for x, y in pairs:
        each = sorted(_by_task(rows, x, y).items(), key=lambda item: item[1].value)
        if each and (mean := difference(rows, rows, x, y)) is not None:
            chance = improvement(rows, x, y)
            ends = [f"{d.value:+.1%} ({task_name(task)})" for task, d in (each[0], each[-1])]
            name = f"{policy_name(x[0])} over {policy_name(y[0])}"
            lines.append((name, _signed(mean), *ends, _probability(chance)))
    return Table(
        title="What the two stages buy",
        caption=(
            "Relative difference of mean returns from the same starts, mean over tasks with its "
            "95% interval, and the tasks where it is lowest and highest; and the probability of "
            "improvement, mean over tasks. BCQ over BC is what stage 1 gives beyond imitation; "
            "Distilled over BCQ what stage 2 costs; Distilled over BCQ with a one-hot task what "
            "two stages give beyond one that is told the task."
        ),
        header=("Policies", "Mean over tasks", "Lowest task", "Highest task", "P(X > Y)"),
        rows=lines,
    )


def spread_table(curves: Mapping[str, Curve]) -> Table:
    """How the spread of returns falls while stage 1 trains.

    Args:
        curves: evaluations by task, the episodes of all seeds together.

    Example:
        >>> curve = [(e, 10 * e, np.array([100.0 - 10 / e, 100 + 10 / e])) for e in range(1, 11)]
        >>> spread_table({"lift": curve}).rows[0]
        ('Lift', '10', '100.0', '100.0', '7.5', '1.1', '14%')
    """
    lines = []
    for task in (task for task in TASKS if task in curves):
        fifth = max(1, len(curves[task]) // 5)
        returns = [values for _, _, values in curves[task]]
        first, last = returns[:fifth], returns[-fifth:]
        spread = [float(np.mean([values.std() for values in part])) for part in (first, last)]
        lines.append(
            (
                task_name(task),
                str(len(returns)),
                *(f"{np.mean([values.mean() for values in part]):.1f}" for part in (first, last)),
                *(f"{value:.1f}" for value in spread),
                f"{spread[1] / spread[0]:.0%}" if spread[0] else MISSING,
            )
        )
    return Table(
        title="Standard deviation of the returns, early and late",
        caption=(
            "Mean over the first and over the last fifth of the epochs, of an epoch's mean return "
            "and of its standard deviation over episodes and seeds. The paper says of its figure "
            "3 that “even though the means did not change significantly, the variance of the "
            "returns decreased”: a last column below 100%."
        ),
        header=(
            "Task",
            "Epochs",
            "Mean, first fifth",
            "Mean, last fifth",
            "Std, first fifth",
            "Std, last fifth",
            "Last / first",
        ),
        rows=lines,
    )


def ablations_table(episodes: Sequence[EpisodeRow], runs: Sequence[RunRow]) -> Table:
    """What becomes of each policy when one thing is changed, beside the runs without the change.

    Args:
        episodes: episodes of all runs.
        runs: the runs; those of a preset with an ablation are put beside those without one.
    """
    rows: dict[tuple[str, str], list[ResultRow]] = {}
    for episode in episodes:
        rows.setdefault((episode.preset, episode.ablation), []).append(episode.row)
    lines = []
    for preset, ablation in rows:
        mine, base = rows[preset, ablation], rows.get((preset, "none"), [])
        seeds = {row.seed for row in mine}
        accuracies = [
            run.accuracy
            for run in runs
            if run.key[:2] == (preset, ablation) and run.accuracy is not None
        ]
        for arm in arms_of(mine) if ablation != "none" else []:
            if arm == EXPERT or (arm[0] == "distilled" and arm != DISTILLED):
                continue
            tasks = [t for t in TASKS if _returns(mine, arm, [t])]
            gain = difference(mine, base, arm, arm, tasks)
            success = [_success_rate(mine, arm, [task]) for task in TASKS]
            accuracy = f"{np.mean(accuracies):.1%}" if accuracies else MISSING
            lines.append(
                (
                    ablation,
                    preset,
                    policy_name(arm[0]),
                    MISSING if gain is None else _share(gain),
                    *success,
                    accuracy if arm[0] == "distilled" else MISSING,
                    ", ".join(map(str, sorted(seeds))),
                )
            )
    return Table(
        title="One thing changed",
        caption=(
            "Return: mean over tasks of the mean return as a share of what the same policy "
            "returns in the runs of the same preset and seed without the change, on the same "
            "starts, with a 95% interval from episodes resampled in pairs within each task and "
            "seed. It is about these trained policies: another training of the same may differ by "
            "more. Then the success rate by task, and the held-out accuracy of the task "
            f"classifier. Distilled: with the source {DEFAULT_SOURCE}."
        ),
        header=(
            "Change",
            "Preset",
            "Policy",
            "Return",
            *(f"{task_name(task)}: success" for task in TASKS),
            "Accuracy",
            "Seeds",
        ),
        rows=lines,
    )


def clock_table(runs: Sequence[RunRow]) -> Table:
    """Minutes that each stage of each run took.

    Args:
        runs: the runs.
    """

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


def arms_of(rows: Iterable[ResultRow]) -> list[Arm]:
    """The policies and their sources of m, in the order of the tables, the default source first."""
    return sorted(
        {(row.policy, row.latent_source) for row in rows},
        key=lambda arm: (POLICIES.index(arm[0]), arm[1] != DEFAULT_SOURCE, arm[1]),
    )


def _returns(
    rows: Iterable[ResultRow], arm: Arm, tasks: Sequence[str]
) -> dict[tuple[str, int, int], float]:
    """Returns of a policy by task, seed and number of the episode."""
    return {
        (row.task, row.seed, row.episode): row.episode_return
        for row in rows
        if (row.policy, row.latent_source) == arm and row.task in tasks
    }


def _by_task(rows: Sequence[ResultRow], x: Arm, y: Arm) -> dict[str, Estimate]:
    """Difference of two policies on every task; nothing if one of them is missing."""
    found = {task: difference(rows, rows, x, y, [task]) for task in TASKS}
    known = {task: gain for task, gain in found.items() if gain is not None}
    return known if len(known) == len(TASKS) else {}


def _success_rate(rows: Sequence[ResultRow], arm: Arm, tasks: Sequence[str]) -> str:
    hits = [r.success for r in rows if (r.policy, r.latent_source) == arm and r.task in tasks]
    return f"{np.mean(hits):.0%}" if hits else MISSING


def _success_target(name: str, arm: Arm, summaries: Sequence[Summary]) -> list[Target]:
    rates = [
        (s.success_rate, TASKS.index(s.task), s.success_interval)
        for s in summaries
        if (s.policy, s.latent_source) == arm
    ]
    if len(rates) < len(TASKS):
        return []
    rate, index, (low, high) = min(rates)
    where = f"{task_name(TASKS[index])}: [{low:.1%}, {high:.1%}]"
    return [
        Target(what=f"{name}: success", least=0.95, measured=f"{rate:.1%} ({where})", value=rate)
    ]


def _signed(estimate: Estimate) -> str:
    return f"{estimate.value:+.1%} [{100 * estimate.low:+.1f}, {100 * estimate.high:+.1f}]"


def _share(estimate: Estimate) -> str:
    low, high = 100 * (1 + estimate.low), 100 * (1 + estimate.high)
    return f"{1 + estimate.value:.1%} [{low:.1f}, {high:.1f}]"


def _probability(estimate: Estimate | None) -> str:
    if estimate is None:
        return MISSING
    return f"{estimate.value:.0%} [{100 * estimate.low:.0f}, {100 * estimate.high:.0f}]"
