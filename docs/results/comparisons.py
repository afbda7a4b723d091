"""Comparisons of policies and runs, as tables computed from published episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from published import TASKS, EpisodeRow, RunRow

from torchrl_bmrl.evaluation.results import ResultRow, Summary, policy_order
from torchrl_bmrl.evaluation.statistics import (
    Estimate,
    probability_of_improvement,
    relative_difference,
)
from torchrl_bmrl.reports.figures import Curve
from torchrl_bmrl.reports.tables import MISSING, Table, percent, policy_name, task_name

DEFAULT_SOURCE = "prototype"
"""Default source of m of the distilled policy."""

Arm = tuple[str, str]
"""A policy and its source of m, which is empty for all but the distilled policy."""

EXPERT: Arm = ("expert", "")
REFERENCE: Arm = ("reference", "")
BCQ: Arm = ("bcq", "")
DISTILLED: Arm = ("distilled", DEFAULT_SOURCE)


def difference(
    ours: Iterable[ResultRow],
    theirs: Iterable[ResultRow],
    x: Arm,
    y: Arm,
    tasks: Sequence[str] = TASKS,
) -> Estimate | None:
    """Relative difference of mean returns on the same starts; over several tasks, its mean.

    Episodes are paired by task, training seed and number, and resampled in pairs within each task
    and seed. ``ours`` and ``theirs`` are the episodes of which those of the policies ``x`` and
    ``y`` are taken. The result is ``None`` if the policies share no episode on one of the tasks, or
    if the mean return of ``y`` is not positive on one.
    """
    one, other = returns_of(ours, x, tasks), returns_of(theirs, y, tasks)
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


def differences(rows: Sequence[ResultRow], x: Arm, y: Arm) -> dict[str, Estimate]:
    """The :func:`difference` of two policies by task, where it is known."""
    found = {task: difference(rows, rows, x, y, [task]) for task in TASKS}
    return {task: gain for task, gain in found.items() if gain is not None}


def improvement(
    rows: Iterable[ResultRow], x: Arm, y: Arm, tasks: Sequence[str] = TASKS
) -> Estimate | None:
    """Probability of improvement, mean over tasks; ``None`` if tasks or seeds of the two differ."""
    rows = list(rows)
    values = [returns_of(rows, arm, tasks) for arm in (x, y)]
    strata = [[f"{task}/{seed}" for task, seed, _ in value] for value in values]
    if set(strata[0]) != set(strata[1]) or {task for task, _, _ in values[0]} != set(tasks):
        return None
    return probability_of_improvement(
        list(values[0].values()),
        list(values[1].values()),
        x_strata=strata[0],
        y_strata=strata[1],
    )


def seeds_table(rows: Sequence[ResultRow], runs: Sequence[RunRow]) -> Table:
    """Results by training seed, which show how much one training differs from another."""
    lines = []
    for run in runs:
        mine = [row for row in rows if row.seed == run.seed]
        gains = (difference(mine, mine, BCQ, EXPERT), difference(mine, mine, DISTILLED, BCQ))
        lines.append(
            (
                str(run.seed),
                *(MISSING if gain is None else share(gain) for gain in gains),
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


def differences_table(rows: Sequence[ResultRow], arms: Sequence[Arm]) -> Table:
    """Relative difference and probability of improvement over the expert, task by task."""
    lines = []
    for arm in arms:
        for tasks in (*([task] for task in TASKS), TASKS):
            gain = difference(rows, rows, arm, EXPERT, tasks)
            chance = improvement(rows, arm, EXPERT, tasks)
            if gain is not None:
                name = task_name(tasks[0]) if len(tasks) == 1 else "Mean over tasks"
                lines.append((policy_name(arm[0]), name, signed(gain), _probability(chance)))
    return Table(
        title="Difference to the expert, and probability of improvement",
        caption=(
            "Relative difference: mean return of the policy minus that of the expert, over that of "
            "the expert. Both act from the same starts, so episodes are resampled in pairs, "
            "within each training seed. Probability of improvement P(X > Y): how often an episode "
            "of the policy returns more than an episode of the expert of the same seed, over all "
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
    """Policies by tasks: return as a share of the reference's, and success.

    ``arms`` gives the name of each line's policy.
    """
    success = {(s.task, s.policy, s.latent_source): s.success_rate for s in summaries}
    whose = "the expert's" if reference == EXPERT else f"{policy_name(reference[0])}'s"
    lines = []
    for arm, name in arms.items():
        cells = []
        for task in TASKS:
            gain = difference(rows, rows, arm, reference, [task])
            rate = success.get((task, *arm))
            cell = MISSING if gain is None else f"{1 + gain.value:.1%}"
            cells.append(MISSING if rate is None else f"{cell} ({rate:.0%})")
        mean = difference(rows, rows, arm, reference)
        seeds = sorted({row.seed for row in rows if (row.policy, row.latent_source) == arm})
        mean_share = MISSING if mean is None else share(mean)
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
    """Relative differences between pairs of policies."""
    lines = []
    for x, y in pairs:
        each = sorted(differences(rows, x, y).items(), key=lambda item: item[1].value)
        if (mean := difference(rows, rows, x, y)) is not None:
            chance = improvement(rows, x, y)
            ends = [f"{d.value:+.1%} ({task_name(task)})" for task, d in (each[0], each[-1])]
            name = f"{policy_name(x[0])} over {policy_name(y[0])}"
            lines.append((name, signed(mean), *ends, _probability(chance)))
    return Table(
        title="What each stage adds",
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
    """Spread of the returns early and late in stage 1, over the episodes of all seeds together."""
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
    """Runs with one change, beside the runs of the same preset and seed without it."""
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
            if arm in (EXPERT, REFERENCE) or (arm[0] == "distilled" and arm != DISTILLED):
                continue
            tasks = [t for t in TASKS if returns_of(mine, arm, [t])]
            gain = difference(mine, base, arm, arm, tasks)
            success = [_success_rate(mine, arm, [task]) for task in TASKS]
            accuracy = f"{np.mean(accuracies):.1%}" if accuracies else MISSING
            lines.append(
                (
                    ablation,
                    preset,
                    policy_name(arm[0]),
                    MISSING if gain is None else share(gain),
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


def arms_of(rows: Iterable[ResultRow]) -> list[Arm]:
    """Returns the policies and sources of m in the tables' order, the default source first."""
    return sorted(
        {(row.policy, row.latent_source) for row in rows},
        key=lambda arm: (policy_order(arm[0]), arm[1] != DEFAULT_SOURCE, arm[1]),
    )


def baselines_of(rows: Iterable[ResultRow]) -> list[Arm]:
    """Returns the policies that are neither scripted nor of the two stages."""
    ours = ("expert", "reference", "bcq", "distilled")
    return [arm for arm in arms_of(rows) if arm[0] not in ours]


def returns_of(
    rows: Iterable[ResultRow], arm: Arm, tasks: Sequence[str]
) -> dict[tuple[str, int, int], float]:
    """Collects the returns of a policy by task, seed and number of the episode."""
    return {
        (row.task, row.seed, row.episode): row.episode_return
        for row in rows
        if (row.policy, row.latent_source) == arm and row.task in tasks
    }


def _success_rate(rows: Sequence[ResultRow], arm: Arm, tasks: Sequence[str]) -> str:
    hits = [r.success for r in rows if (r.policy, r.latent_source) == arm and r.task in tasks]
    return percent(float(np.mean(hits)) if hits else None)


def signed(estimate: Estimate) -> str:
    """Returns a difference with its interval as tables print it."""
    return f"{estimate.value:+.1%} [{100 * estimate.low:+.1f}, {100 * estimate.high:+.1f}]"


def share(estimate: Estimate) -> str:
    """Returns a relative difference as a share, with its interval, as tables print it."""
    low, high = 100 * (1 + estimate.low), 100 * (1 + estimate.high)
    return f"{1 + estimate.value:.1%} [{low:.1f}, {high:.1f}]"


def _probability(estimate: Estimate | None) -> str:
    if estimate is None:
        return MISSING
    return f"{estimate.value:.0%} [{100 * estimate.low:.0f}, {100 * estimate.high:.0f}]"
