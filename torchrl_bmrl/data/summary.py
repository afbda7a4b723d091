"""Summarises a data set, with all of its faults and oddities."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from torchrl_bmrl.data.account import Account
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.oddities import Oddities
from torchrl_bmrl.data.options import Bounds, ReadOptions
from torchrl_bmrl.data.schema import Layout, find_problems, layout_of
from torchrl_bmrl.errors import DataError

SATURATED = 0.999
"""An action of this absolute value counts as being at its bound."""


@dataclass
class Extent:
    """Range of an array's numbers, for each element of a row.

    Attributes:
        dtype: as text.
        low: smallest of each element.
        high: largest of each element.
        saturated: number of rows in which each element is at a bound.
    """

    dtype: str
    low: np.ndarray
    high: np.ndarray
    saturated: np.ndarray

    @classmethod
    def of(cls, array: np.ndarray, bounds: Bounds | None = None) -> Extent:
        """Range of one episode's array, and how often it is at its bounds."""
        low, high = array.min(0), array.max(0)
        saturated = np.zeros(low.shape, dtype=np.int64)
        if bounds is not None:
            first, last = (np.asarray(bound, dtype=float) for bound in bounds)
            apart = np.abs(array - (first + last) / 2)
            saturated += (apart >= SATURATED * (last - first) / 2).sum(0)
        return cls(str(array.dtype), low, high, saturated)

    def include(self, other: Extent) -> None:
        """Includes the range of another episode."""
        self.low = np.minimum(self.low, other.low)
        self.high = np.maximum(self.high, other.high)
        self.saturated = self.saturated + other.saturated


@dataclass
class Summary:
    """Content of a data set, its faults, and its oddities.

    Attributes:
        lengths: number of steps of each sound episode.
        returns: undiscounted sum of rewards of each.
        successes: whether each succeeded at some step; empty if the file does not state it.
        failed: names of those that did not.
        account: what was read, and what was left out.
        terminated: number of episodes that end by termination; the others are truncated.
        ranges: of the actions and of each part of the observation.
        problems: faults that keep the data from being trained on: key and message of each.
        warnings: oddities, which may be intended.
    """

    lengths: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    successes: list[bool] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    account: Account = field(default_factory=Account)
    terminated: int = 0
    ranges: dict[str, Extent] = field(default_factory=dict)
    problems: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def summarise(
    episodes: Mapping[str, Episode],
    *,
    prefix: str = "",
    bounds: Bounds | None = (-1.0, 1.0),
    account: Account | None = None,
    options: ReadOptions | None = None,
    look: Callable[[str, Episode | None], object] = lambda name, episode: None,
) -> Summary:
    """Checks every episode, and continues after faults.

    Args:
        episodes: by name; a DataError on reading one becomes a problem.
        prefix: of the names, for messages.
        bounds: of floating-point actions; ``None`` for any.
        account: of what is left out so far; the episodes are added to it.
        options: how the episodes are read.
        look: called with every name and its episode, or ``None`` if it cannot be read.
    """
    summary = Summary(account=account or Account())
    layout: Layout | None = None
    seen: dict[str, list[str]] = {}
    jumps: list[str] = []
    oddities = Oddities()
    for name in episodes:
        try:
            episode = episodes[name]
        except DataError as error:
            summary.problems.append((error.key or "", error.message))
            look(name, None)
            continue
        problems = list(find_problems(episode, layout=layout, bounds=bounds))
        summary.problems += [(f"{prefix}{name}/{key}", message) for key, message in problems]
        # Steps of faulty episodes are not counted, so neither are those at the bounds.
        _add_ranges(summary, episode, None if problems else bounds)
        if not problems:
            layout = layout or layout_of(episode)
            _add(summary, name, episode)
            oddities.add(name, episode)
            seen.setdefault(_digest(episode), []).append(name)
            if not is_continuous(episode):
                jumps.append(name)
        look(name, episode)
    if not len(episodes):
        summary.problems.append((prefix.rstrip("/"), "no episodes; valid: at least one"))
    if refusal := summary.account.refusal(options or ReadOptions()):
        summary.problems.append(refusal)
    summary.warnings = [
        *summary.account.warnings(),
        *_warnings(summary, bounds),
        *_repeats(seen),
        *_jumps(jumps),
        *oddities.warnings(),
    ]
    return summary


def is_continuous(episode: Episode) -> bool:
    """Whether each next observation equals the observation of the following step."""
    return all(
        np.array_equal(episode.next_observations[name][:-1], part[1:])
        for name, part in episode.observations.items()
    )


def _add(summary: Summary, name: str, episode: Episode) -> None:
    summary.account.add(name, episode)
    summary.lengths.append(len(episode))
    summary.returns.append(float(episode.rewards.sum(dtype=np.float64)))
    summary.terminated += int(episode.terminated[-1])
    if (succeeded := episode.succeeded) is not None:
        summary.successes.append(succeeded)
        summary.failed += [] if succeeded else [name]


def _add_ranges(summary: Summary, episode: Episode, bounds: Bounds | None) -> None:
    """Includes all comparable arrays, even those out of bounds, so that the ranges show it."""
    for name, array in {"actions": episode.actions, **episode.observations}.items():
        if array.dtype.kind not in "biuf" or not array.ndim or 0 in array.shape:
            continue
        known = summary.ranges.get(name)
        extent = Extent.of(array, bounds if name == "actions" else None)
        if known is None:
            summary.ranges[name] = extent
        elif np.shape(known.low) == array.shape[1:]:
            known.include(extent)


def _digest(episode: Episode) -> str:
    digest = hashlib.sha256()
    for array in (episode.actions, *episode.observations.values()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _warnings(summary: Summary, bounds: Bounds | None) -> Iterator[str]:
    count, steps = len(summary.lengths), sum(summary.lengths)
    if short := summary.lengths.count(1):
        yield f"{short} of {count} episodes have a single step"
    if count > 1 and summary.terminated == count and len(set(summary.lengths)) == 1:
        yield (
            f"all {count} episodes terminate after exactly {summary.lengths[0]} steps: is that a "
            "horizon? A horizon truncates, and values are bootstrapped after it"
        )
    for key, extent in summary.ranges.items():
        constant = np.flatnonzero(extent.low == extent.high)
        if len(constant):
            yield f"{key}: constant in {_dimensions(constant, extent.low.size)}"
    actions = summary.ranges.get("actions")
    if actions is None or not actions.dtype.startswith("float"):
        return
    share = np.ravel(actions.saturated / max(1, steps))
    # A dimension that is always there has two commands, such as a gripper's.
    for i in np.flatnonzero((share > 0.5) & (share < 1)):
        yield f"actions: dimension {i} is at a bound in {share[i]:.0%} of all steps"
    if bounds is None and (np.min(actions.low) < -1 or np.max(actions.high) > 1):
        yield "actions: outside [-1, 1]; give the loss their bounds"


def _dimensions(index: np.ndarray, size: int) -> str:
    if len(index) == size:
        return "every dimension"
    named = ", ".join(map(str, index[:8]))
    return f"dimensions {named}{', ...' if len(index) > 8 else ''} of {size}"


def _repeats(seen: Mapping[str, list[str]]) -> Iterator[str]:
    for names in seen.values():
        if len(names) > 1:
            yield f"the same episode occurs {len(names)} times: {', '.join(names[:8])}"


def _jumps(names: list[str]) -> Iterator[str]:
    if names:
        yield (
            f"next observations differ from the following steps' observations in {len(names)} "
            f"episodes, such as {names[0]}: are their steps in order?"
        )
