"""The tables of held-out members, of one run or of several; ``docs/families.md`` explains them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_bmrl.evaluation import Estimate, clustered_ratio
from torchrl_bmrl.families import SPLITS
from torchrl_bmrl.reports import Table
from torchrl_bmrl.reports.tables import MISSING

COMPARED = {"demonstration": "Demonstration minus this", "one_shot": "One-shot minus this"}
"""Methods that are compared with every other, and the titles of these columns."""
Key = tuple[str, str, str, int]
"""Family, run, member and number of an episode."""


def make_tables(
    title: str, methods: Mapping[str, str], rows: Sequence[Mapping[str, Any]]
) -> dict[str, Table]:
    """Returns and success, returns as shares of others, and differences of two policies.

    Args:
        title: of the family, or of several.
        methods: titles of the methods by name.
        rows: of the study's ``results.csv``, of one run or of several; those of several have a
            column ``run``. Numbers of several families are means over these.

    Returns:
        the tables by the end of their files' names: ``""``, ``"_shares"`` and ``"_differences"``.
    """
    first, shares, differences = [], [], []
    for split in SPLITS[1:]:
        of = {name: _episodes(rows, split, name) for name in methods}
        columns = ("return", "data_return", "success")
        values = {name: [_column(of[name], column) for column in columns] for name in methods}
        told = values["told"][0] if "told" in values else {}
        for method, name in methods.items():
            mine, data, success = values[method]
            if not mine:
                continue
            line = [split, name]
            mean = f"{sum(mine.values()) / len(mine):.1f}" if len(_families(mine)) == 1 else MISSING
            first.append([*line, mean, _percent(_ratio(success)), str(len(mine))])
            found = [_ratio(mine, told), _ratio(mine, data)]
            shares.append([*line, *map(_text, found)])
            # The policy that is told makes a scale; without it, the demonstration does.
            scale = told if _ratio(mine, told) else data
            cells = [
                MISSING if other == method else _text(_difference(values[other][0], mine, scale))
                for other in COMPARED
                if other in methods
            ]
            differences.append([*line, *cells])
    runs = {key[:2] for name in methods for key in _column(_episodes(rows, None, name), "return")}
    of_families = Counter(family for family, _ in runs)
    over = "training seeds and members" if min(of_families.values(), default=1) > 1 else "members"
    note = f"Brackets: 95% intervals, which cover the variation over {over}."
    start = ("Members", "Policy")
    held_out = f"Held-out members of {title}"
    return {
        "": Table(
            title=held_out,
            caption=f"Members of the family that no agent was trained on. {note}",
            header=(*start, "Return", "Success", "Episodes"),
            rows=first,
        ),
        "_shares": Table(
            title=f"{held_out}: shares of the return",
            caption=(
                "Return / told: mean return over that of the policy that is told the parameter, "
                "from the same starts. Return / data: mean return over that of the demonstration "
                f"of the member. {note}"
            ),
            header=(*start, "Return / told", "Return / data"),
            rows=shares,
        ),
        "_differences": Table(
            title=f"{held_out}: differences",
            caption=(
                "Mean return of m of one demonstration, and of m of its own first episode, less "
                "that of the policy in the line, from the same starts, over the mean return of the "
                "policy that is told the parameter; without it, over that of the demonstrations. "
                f"{note}"
            ),
            header=(*start, *(name for method, name in COMPARED.items() if method in methods)),
            rows=differences,
        ),
    }


def _episodes(
    rows: Sequence[Mapping[str, Any]], split: str | None, method: str
) -> dict[Key, Mapping[str, Any]]:
    return {
        (row.get("family", ""), row.get("run", ""), row["member"], row["episode"]): row
        for row in rows
        if row["method"] == method and split in (None, row["split"])
    }


def _column(episodes: Mapping[Key, Mapping[str, Any]], column: str) -> dict[Key, float]:
    """Numbers of a column by episode; none unless every episode has one."""
    found = {key: row.get(column, "") for key, row in episodes.items()}
    if any(value in ("", None) for value in found.values()):
        return {}
    return {key: float(value) for key, value in found.items()}


def _families(values: Mapping[Key, float]) -> set[str]:
    return {family for family, *_ in values}


def _ratio(x: Mapping[Key, float], y: Mapping[Key, float] | None = None) -> Estimate | None:
    """Mean of x over mean of y on the episodes of both; ``None`` if a family has no such share."""
    keys = sorted(x) if y is None else sorted(x.keys() & y.keys())
    if not keys or {key[0] for key in keys} != _families(x):
        return None
    families, runs, members, _ = zip(*keys, strict=True)
    scale = None if y is None else [y[key] for key in keys]
    for family in set(families):
        if scale and not sum(s for s, f in zip(scale, families, strict=True) if f == family) > 0:
            return None
    values = [x[key] for key in keys]
    return clustered_ratio(values, scale, runs=runs, members=members, groups=families)


def _difference(
    ours: Mapping[Key, float], theirs: Mapping[Key, float], scale: Mapping[Key, float]
) -> Estimate | None:
    shared = ours.keys() & theirs.keys()
    return _ratio({key: ours[key] - theirs[key] for key in shared}, scale)


def _text(found: Estimate | None) -> str:
    return MISSING if found is None else str(found).replace("-0.00", "0.00")


def _percent(found: Estimate | None) -> str:
    if found is None:
        return MISSING
    low, high = max(found.low, 0.0), min(found.high, 1.0)
    return f"{found.value:.0%} [{low:.0%}, {high:.0%}]"
