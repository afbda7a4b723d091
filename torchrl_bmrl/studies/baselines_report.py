"""Tables of the baselines: mean returns, and paired differences to the references."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchrl_bmrl.evaluation import (
    Estimate,
    ResultRow,
    bootstrap_interval,
    paired_difference,
    summarise,
)
from torchrl_bmrl.evaluation.paired import EXPERT, Arm
from torchrl_bmrl.evaluation.results import policy_order
from torchrl_bmrl.reports.tables import MISSING, Table, policy_name, task_titles

REFERENCES = ("bc", "iql")
"""Policies to which the others are compared."""


def make_table(
    rows: Sequence[ResultRow],
    updates: int,
    titles: Mapping[str, str],
    coefficients: Mapping[str, Mapping[str, float]] | None = None,
) -> Table:
    """One line per policy and one column per task.

    Args:
        rows: episodes.
        updates: of each baseline.
        titles: of the tasks by name, in the order of the columns.
        coefficients: coefficients that differ from the published ones, by name, by algorithm.
    """
    found = {(s.policy, s.latent_source, s.task): s for s in summarise(rows)}
    columns = _columns(rows, titles)
    lines = []
    for policy, source in _arms(rows):
        mine = [row for row in rows if (row.policy, row.latent_source) == (policy, source)]
        line = [_name(policy, source)]
        for task in columns:
            cell = MISSING
            if (each := found.get((policy, source, task))) is not None:
                cell = f"{each.mean_return:.1f}"
                cell += "" if each.success_rate is None else f", {each.success_rate:.0%}"
            line.append(cell)
        successes = [float(row.success) for row in mine if row.success is not None]
        if len(successes) == len(mine):
            low, high = bootstrap_interval(successes, strata=[row.task for row in mine])
            line += [f"{sum(successes) / len(mine):.0%}", f"[{low:.0%}, {high:.0%}]"]
        else:
            line += [MISSING, MISSING]
        lines.append((*line, str(len(mine))))
    tuned = [
        f"{policy_name(algorithm)} {name} = {value:g}"
        for algorithm, values in (coefficients or {}).items()
        for name, value in values.items()
    ]
    return Table(
        title="The two stages beside other offline algorithms",
        caption=(
            "Mean return over an episode, and success, on the same starts; the expert's are its "
            "demonstrations unless it was evaluated. BCQ: stage 1, one agent per task. Distilled: "
            "stage 2, with the source of m in brackets. BC, TD3+BC, IQL and CQL: TorchRL's losses, "
            "one policy per task; ReBRAC: this library's. BC, best episodes: of the demonstrations "
            "with the largest returns. BCQ, one-hot task: one agent trained on all tasks, whose "
            f"observation contains the task's index. {updates:,} updates each. Coefficients: "
            f"{', '.join(tuned) + ', otherwise ' if tuned else ''}as published; those of ReBRAC, "
            "which has none for all data, are 0.1 by default. Interval: "
            "bootstrap over the episodes of each task."
        ),
        header=("Policy", *columns.values(), "Success, all", "95% interval", "Episodes"),
        rows=lines,
    )


def make_paired_table(
    rows: Sequence[ResultRow],
    titles: Mapping[str, str],
    *,
    policies: Sequence[Arm] | None = None,
    references: Sequence[str] = REFERENCES,
) -> Table:
    """Each policy less each reference, on the same starts: mean over tasks, and task by task.

    Args:
        rows: episodes of the policies and of the expert, of one run or of several with different
            seeds.
        titles: of the tasks by name, in the order of the columns.
        policies: policies and their sources of m; ``None`` for all.
        references: names of the policies to which they are compared.
    """
    columns, arms = _columns(rows, titles), _arms(rows)
    lines = []
    for reference in [(name, "") for name in references if (name, "") in arms]:
        for arm in arms if policies is None else policies:
            if arm in (EXPERT, reference):
                continue
            cells = [
                _signed(paired_difference(rows, arm, reference, tasks))
                for tasks in (list(columns), *([task] for task in columns))
            ]
            lines.append((_name(*arm), policy_name(reference[0]), *cells))
    return Table(
        title="Differences on the same starts",
        caption=(
            "Return of the policy minus that of the reference from the same start, as a share of "
            "the expert's mean return of the task, with a 95% interval: bootstrap over the pairs "
            "of episodes within each task and training seed. It is about these trained policies; "
            "another training may differ by more."
        ),
        header=("Policy", "Reference", "Mean over tasks", *columns.values()),
        rows=lines,
    )


def _arms(rows: Sequence[ResultRow]) -> list[Arm]:
    """The policies and sources of m in the order of the lines."""
    arms = {(row.policy, row.latent_source) for row in rows}
    return sorted(arms, key=lambda arm: (policy_order(arm[0]), arm))


def _columns(rows: Sequence[ResultRow], titles: Mapping[str, str]) -> dict[str, str]:
    """The titles of the tasks that have episodes, by name."""
    present = {row.task for row in rows}
    return {name: title for name, title in task_titles(present, titles).items() if name in present}


def _name(policy: str, source: str) -> str:
    return policy_name(policy) + (f" ({source})" if source else "")


def _signed(estimate: Estimate | None) -> str:
    if estimate is None:
        return MISSING
    return f"{estimate.value:+.1%} [{100 * estimate.low:+.1f}, {100 * estimate.high:+.1f}]"
