"""Targets of the two stages, and whether the published episodes meet them."""

from __future__ import annotations

from collections.abc import Sequence

from comparisons import (
    BCQ,
    DEFAULT_SOURCE,
    DISTILLED,
    EXPERT,
    REFERENCE,
    Arm,
    arms_of,
    difference,
    differences,
    returns_of,
    share,
    signed,
)
from published import TASKS, RunRow

from torchrl_bmrl.evaluation import paired_difference
from torchrl_bmrl.evaluation.results import ResultRow, Summary
from torchrl_bmrl.evaluation.statistics import Estimate, relative_difference
from torchrl_bmrl.reports import paper
from torchrl_bmrl.reports.tables import Table, policy_name, task_name

COVERED = 0.9
"""Share of the distance from expert to scripted optimum that is asked for where the paper's ratio
is out of reach."""
EXCEEDED = ("bc", "iql")
"""Algorithms that BCQ should exceed on weak demonstrations, with whatever coefficients."""

Target = tuple[str, str, str, str]
"""What is measured, what was asked for, the measured number, and whether it is met."""


def target(what: str, asked: str, measured: str, met: bool) -> Target:
    """Returns a line of a table of targets."""
    return what, asked, measured, "yes" if met else "no"


def success_targets(name: str, summaries: Sequence[Summary], arm: Arm) -> list[Target]:
    """Compares a policy's success on the worst task with 95%, if every task was evaluated."""
    mine = [s for s in summaries if (s.policy, s.latent_source) == arm]
    rates = [(s.success_rate, s.task, s.success_interval) for s in mine]
    if len(rates) < len(TASKS):
        return []
    rate, task, (low, high) = min(rates, key=lambda row: (row[0], TASKS.index(row[1])))
    measured = f"{rate:.1%} ({task_name(task)}: [{low:.1%}, {high:.1%}])"
    return [target(f"{name}: success", "at least 95%", measured, rate >= 0.95)]


def distilled_targets(rows: Sequence[ResultRow], arm: Arm, name: str = "") -> list[Target]:
    """Compares the distilled policy's share of BCQ's return with 98%, on the worst task."""
    gains = differences(rows, arm, BCQ)
    if len(gains) < len(TASKS):
        return []
    task, gain = min(gains.items(), key=lambda item: item[1].value)
    value = 1 + gain.value
    what = f"Distilled{name}: return as a share of BCQ's"
    measured = f"{value:.1%} ({task_name(task)}: {share(gain)})"
    return [target(what, "at least 98%", measured, value >= 0.98)]


def targets_table(
    rows: Sequence[ResultRow], summaries: Sequence[Summary], runs: Sequence[RunRow]
) -> Table:
    """Compares both stages with their targets; numbers not measured on every task are left out."""
    lines: list[Target] = []
    if len(gains := differences(rows, BCQ, EXPERT)) == len(TASKS):
        task, gain = min(gains.items(), key=lambda item: item[1].low)
        what = "BCQ over the expert: lower end of the interval of the relative difference"
        measured = f"{gain.low:+.1%} ({task_name(task)}: {signed(gain)})"
        lines.append(target(what, "at least -2%", measured, gain.low >= -0.02))
    lines += success_targets("BCQ", summaries, BCQ)
    lines += distilled_targets(rows, DISTILLED)
    lines += success_targets("Distilled", summaries, DISTILLED)
    if accuracies := [(run.accuracy, run.seed) for run in runs if run.accuracy is not None]:
        accuracy, seed = min(accuracies)
        what = "Accuracy of the task classifier on held-out transitions"
        asked, measured = f"at least {paper.ACCURACY:.0%}", f"{accuracy:.1%} (seed {seed})"
        lines.append(target(what, asked, measured, accuracy >= paper.ACCURACY))
    return Table(
        title="Targets",
        caption=(
            "Each number is that of the worst task or seed, with the interval of that task. "
            f"Distilled: with the default source of m, {DEFAULT_SOURCE}."
        ),
        header=("What", "Asked", "Measured", "Met"),
        rows=lines,
    )


def weak_targets_table(rows: Sequence[ResultRow], summaries: Sequence[Summary]) -> Table:
    """Compares the runs on weak demonstrations with their targets, as far as these are measured."""
    lines = [line for task in TASKS for line in _gain_targets(rows, task)]
    lines += success_targets("BCQ", summaries, BCQ)
    if source := best_source(rows):
        name = f" ({source[1]})"
        lines += distilled_targets(rows, source, name)
        lines += success_targets(f"Distilled{name}", summaries, source)
    names = [policy_name(algorithm) for algorithm in EXCEEDED]
    for arm in arms_of(rows):
        if policy_name(arm[0]).partition(" (")[0] in names:  # coefficients follow in brackets
            lines += _paired_targets(rows, arm)
    return Table(
        title="Targets",
        caption=(
            "BCQ over the expert: the target is the paper's ratio of the two returns. This ratio "
            f"can be higher than the scripted optimum's. Then BCQ must cover {COVERED:.0%} of the "
            "distance between the returns of the expert and of the scripted optimum, and the "
            "interval resamples the starts of all three policies. Success, and the distilled "
            "policy's share of BCQ's return: the value and the interval of the worst task. "
            "Distilled: one source of m for all tasks, the one whose worst share of BCQ's return "
            "is highest. Paired differences: from the same starts, as shares of the expert's "
            "return. A difference is significantly below 0 if its whole interval is below 0."
        ),
        header=("What", "Asked", "Measured", "Met"),
        rows=lines,
    )


def best_source(rows: Sequence[ResultRow]) -> Arm | None:
    """Returns the distilled policy with the source of m whose worst share of BCQ is highest.

    Sources that were not evaluated on every task are ignored.
    """
    worst = {}
    for arm in arms_of(rows):
        gains = differences(rows, arm, BCQ) if arm[0] == "distilled" else {}
        if len(gains) == len(TASKS):
            worst[arm] = min(gain.value for gain in gains.values())
    return max(worst, key=worst.__getitem__) if worst else None


def covered(rows: Sequence[ResultRow], arm: Arm, task: str) -> Estimate | None:
    r"""Computes the share of the distance from expert to scripted optimum that a policy covers.

    .. math:: (\bar x - \bar e) / (\bar r - \bar e)

    over the starts that all three share. It is ``None`` without such starts, or if the scripted
    optimum does not exceed the expert on them.
    """
    ours, expert, reference = (returns_of(rows, a, [task]) for a in (arm, EXPERT, REFERENCE))
    shared = sorted(ours.keys() & expert.keys() & reference.keys())
    gained = [ours[key] - expert[key] for key in shared]
    possible = [reference[key] - expert[key] for key in shared]
    if not sum(possible) > 0.0:
        return None
    gap = relative_difference(gained, possible, strata=[seed for _, seed, _ in shared])
    return Estimate(value=1 + gap.value, low=1 + gap.low, high=1 + gap.high)


def _gain_targets(rows: Sequence[ResultRow], task: str) -> list[Target]:
    """Compares BCQ's gain over the expert with the paper's, or with what is possible."""
    gain = difference(rows, rows, BCQ, EXPERT, [task])
    if gain is None:
        return []
    what, printed = f"BCQ over the expert: {task_name(task)}", paper.TABLE_1[task]
    ratio = round(printed.bcq_return / printed.expert_return, 2)
    best = difference(rows, rows, REFERENCE, EXPERT, [task])
    if best is None or ratio <= 1 + best.value:
        return [target(what, f"at least {ratio:.0%}", share(gain), 1 + gain.value >= ratio)]
    asked = f"{COVERED:.0%} of the distance to the scripted optimum ({1 + best.value:.0%})"
    asked += f"; the paper's {ratio:.0%} is above it"
    # Without a distance to cover, the target is the scripted optimum itself.
    if (part := covered(rows, BCQ, task)) is None:
        return [target(what, asked, share(gain), gain.value >= best.value)]
    distance = f"{part.value:.1%} [{100 * part.low:.1f}, {100 * part.high:.1f}] of the distance"
    return [target(what, asked, f"{distance}; {share(gain)}", part.value >= COVERED)]


def _paired_targets(rows: Sequence[ResultRow], other: Arm) -> list[Target]:
    """Asks that BCQ exceeds a policy on the mean over tasks and is below it on none."""
    mean = paired_difference(rows, BCQ, other, TASKS)
    each = {task: paired_difference(rows, BCQ, other, [task]) for task in TASKS}
    known = {task: gain for task, gain in each.items() if gain is not None}
    if mean is None or len(known) < len(TASKS):
        return []
    name = policy_name(other[0])
    task, lowest = min(known.items(), key=lambda item: item[1].high)
    return [
        target(
            f"BCQ minus {name}: paired difference, mean over tasks",
            "interval above 0",
            signed(mean),
            mean.low > 0.0,
        ),
        target(
            f"BCQ minus {name}: paired difference, lowest task",
            "not significantly below 0",
            f"{signed(lowest)} ({task_name(task)})",
            lowest.high >= 0.0,
        ),
    ]
