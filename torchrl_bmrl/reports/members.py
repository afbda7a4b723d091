"""The members of a family in the embedding m: each is a point, and a click plays its episode."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.families import Family
from torchrl_bmrl.files import read_json, write_atomic
from torchrl_bmrl.reports.drawing import plane
from torchrl_bmrl.reports.explorer import StoredExplorer
from torchrl_bmrl.reports.tables import MISSING

with needs("reports"):
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

GROUPS = {
    "train": ("trained", "circle"),
    "inside": ("held out, inside the trained range", "diamond"),
    "outside": ("held out, outside the trained range", "triangle"),
}
"""Name and mark of each split."""
LINEAR, CYCLIC = "viridis", "twilight"
"""Colour scales that people with any common kind of colour vision can read."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """One episode of a member, to be played.

    Args:
        frames: WebP pictures as base64 text, by step; empty if the task cannot be rendered.
        episode_return: Sum of the rewards.
        success: Whether the episode succeeded; ``None`` if the task does not define it.
        period: Duration of a step [s]; ``None`` if unknown.

    Example:
        >>> Film(frames={"0": "UklGRg=="}, episode_return=1.0, success=True, period=0.05).success
        True
    """

    frames: dict[str, str]
    episode_return: float
    success: bool | None
    period: float | None


def write_film(path: Path, film: Film) -> None:
    """Writes a film's file, or leaves the old one."""
    write_atomic(path, json.dumps(asdict(film), allow_nan=False) + "\n")


def read_film(path: Path) -> Film:
    """Reads a film.

    Raises:
        DataError: if the file is missing or damaged.
    """
    content = read_json(path, "a film; remove it")
    try:
        film = Film(**content)
        _ = sorted(map(int, film.frames)), f"{film.episode_return:f}"
    except (ValueError, TypeError, AttributeError) as error:
        raise DataError(path, None, f"not a film ({error}); remove it") from error
    return film


@dataclass(frozen=True, kw_only=True)
class Member:
    """A member of a family in the embedding.

    Args:
        title: Title of its task.
        split: ``"train"``, ``"inside"`` or ``"outside"``.
        parameter: Its numbers, in the order of the family's.
        task_latent: The point m that its demonstration gives, shape ``(d,)``.
        film: An episode that the policy plays with this m, if there is one.
    """

    title: str
    split: str
    parameter: tuple[float, ...]
    task_latent: NDArray[Any]
    film: Film | None = None


def explore_members(
    family: Family, members: Sequence[Member], *, demonstrations: int = 1, note: str = ""
) -> StoredExplorer:
    """Draws the members' points m, coloured by their parameter.

    Args:
        family: The family.
        members: Members, at least one of them trained. For m of more than two dimensions the first
            two principal components of the trained members' points are drawn.
        demonstrations: Number of demonstrations that give a point.
        note: Why there are no films.
    """
    latents = np.stack([member.task_latent for member in members])
    trained = latents[[member.split == "train" for member in members]]
    points, projection = plane(latents, of=trained)
    axis = "principal component" if "principal" in projection else "m"
    filmed = any(member.film and member.film.frames for member in members)
    content: dict[str, Any] = {
        "still": True,
        "description": f"Scatter plot of the members of {family.title} in the embedding m, "
        "coloured by their parameter; the menu Task lists them",
        "axes": [f"{axis} 1 (no unit)", f"{axis} 2 (no unit)"],
        "parameters": _parameters(family, members),
        "groups": [{"name": name, "mark": mark} for name, mark in GROUPS.values()],
        "facts": [*family.parameters, "Member", *(("Return", "Success") if filmed else ())],
        "tasks": [_task(member) for member in members],
        "note": f"There are no films: {note}" if note else "",
        "episodes": [_episode(i, points[i], member) for i, member in enumerate(members)],
    }
    given = "one demonstration" if demonstrations == 1 else f"{demonstrations} demonstrations"
    drawn = projection.strip().replace(
        ", its first two principal components",
        "; drawn are the first two principal components of the trained members' points",
    )
    caption = [
        f"The members of {family.title} in the embedding m: each point is the m of {given} that "
        "training did not use.",
        f"m is {drawn}." if drawn else "",
        "Colours repeat where the parameter does." if family.period else "",
        "Click a point to play an episode of that member: the distilled policy acts with this m. "
        "The menu Task and the button Play do the same from the keyboard."
        if filmed
        else content["note"],
    ]
    return StoredExplorer(content=content, caption=" ".join(filter(None, caption)))


def _parameters(family: Family, members: Sequence[Member]) -> list[dict[str, Any]]:
    found = []
    for name, values in zip(
        family.parameters, zip(*(member.parameter for member in members), strict=True), strict=True
    ):
        low, high, period = min(values), max(values), family.period
        legend = f"{name}: {_number(low)} to {_number(high)}"
        if period:
            low, high, values = 0, period, tuple(value % period for value in values)
            legend = f"{name}: 0 to {period:g}, where it starts again"
        scale = colormaps[CYCLIC if period else LINEAR]
        found.append(
            {
                "name": name,
                "legend": legend,
                "low": low,
                "high": high,
                "values": values,
                "scale": [to_hex(scale(share)) for share in np.linspace(0.0, 1.0, 17)],
            }
        )
    return found


def _task(member: Member) -> dict[str, Any]:
    film = member.film
    success = MISSING if film is None or film.success is None else "yes" if film.success else "no"
    return {
        "name": member.title,
        "group": list(GROUPS).index(member.split),
        "period": film and film.period,
        "facts": [
            *map(_number, member.parameter),
            GROUPS[member.split][0],
            MISSING if film is None else f"{film.episode_return:.1f}",
            success,
        ],
    }


def _number(value: float) -> str:
    return f"{value:.4g}".replace("-", "−")


def _episode(task: int, point: NDArray[Any], member: Member) -> dict[str, Any]:
    frames = member.film.frames if member.film else {}
    steps = sorted(map(int, frames)) or [0]
    x, y = ([float(f"{value:.5g}")] * len(steps) for value in point)
    unknown = [None] * len(steps)
    return {"task": task, "step": steps, "x": x, "y": y, "distance": unknown, "frames": frames}
