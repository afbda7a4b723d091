"""The table of held-out members; ``docs/families.md`` explains it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_bmrl.evaluation import bootstrap_interval
from torchrl_bmrl.evaluation.statistics import relative_difference
from torchrl_bmrl.reports import Table
from torchrl_bmrl.reports.tables import MISSING

SPLIT_TITLES = {"inside": "inside the trained range", "outside": "outside"}


def make_table(title: str, methods: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return over that of the policy that is told the parameter, and success, by split.

    Args:
        title: of the family.
        methods: titles of the methods by name.
        rows: of the study's ``results.csv``, of one run or of several.
    """
    lines = []
    for split, place in SPLIT_TITLES.items():
        told = _outcomes(rows, split, "told")
        for method, name in methods.items():
            mine = _outcomes(rows, split, method)
            if not mine:
                continue
            ratio = MISSING
            shared = sorted(mine.keys() & told.keys())
            returns, theirs = ([of[key][0] for key in shared] for of in (mine, told))
            if sum(theirs) > 0:  # else there is no share of it
                members = [key[-2] for key in shared]
                found = relative_difference(returns, theirs, strata=members)
                low, high = 1 + found.low, 1 + found.high
                ratio = f"{1 + found.value:.3f} [{low:.3f}, {high:.3f}]"
            returns = [value for value, _ in mine.values()]
            line = [place, name, f"{sum(returns) / len(returns):.1f}", ratio]
            lines.append([*line, _success(mine), str(len(mine))])
    return Table(
        title=f"Held-out members of {title}",
        caption=(
            "Members of the family that no agent was trained on. Return / told: mean return over "
            "that of the policy that is told the parameter, from the same starts. Brackets: 95% "
            "bootstrap interval over episodes, of each member at its own number; empty where that "
            "policy's mean return is not above 0."
        ),
        header=("Members", "Policy", "Return", "Return / told", "Success", "Episodes"),
        rows=lines,
    )


def _outcomes(
    rows: Sequence[Mapping[str, Any]], split: str, method: str
) -> dict[tuple[Any, ...], tuple[float, str]]:
    """Return and success by run, member and episode."""
    return {
        (row.get("run", ""), row["member"], row["episode"]): (row["return"], str(row["success"]))
        for row in rows
        if (row["split"], row["method"]) == (split, method)
    }


def _success(outcomes: Mapping[tuple[Any, ...], tuple[float, str]]) -> str:
    known = {key: float(success) for key, (_, success) in outcomes.items() if success != ""}
    if not known:
        return MISSING
    members = [key[-2] for key in known]
    low, high = bootstrap_interval(list(known.values()), strata=members)
    share = sum(known.values()) / len(known)
    return f"{share:.0%} [{low:.0%}, {high:.0%}]"
