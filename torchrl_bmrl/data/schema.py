"""What demonstrations must look like before anything trains on them, and what they look like."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchrl_bmrl.data.account import Account
from torchrl_bmrl.data.episodes import Episode, name_fault
from torchrl_bmrl.data.oddities import Oddities
from torchrl_bmrl.data.options import Bounds, ReadOptions
from torchrl_bmrl.errors import ConfigError, DataError

OBSERVATION_SHAPES: dict[str, int] = {
    "robot0_joint_pos": 7,
    "robot0_gripper_qpos": 2,
    "robot0_joint_vel": 7,
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "goal_pos": 3,
}
"""Parts of the six tasks' observation and their sizes, in the environment's order."""
ACTION_DIM = 7
ACTION_TOLERANCE = 1e-6
SATURATED = 0.999
"""An action of this size counts as being at its bound."""

FLOAT32 = float(np.finfo(np.float32).max)

Layout = dict[str, tuple[tuple[int, ...], np.dtype]]


def arrays_of(episode: Episode) -> dict[str, np.ndarray]:
    """All arrays of an episode under their names in robomimic's layout."""
    return {
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminated": episode.terminated,
        **{f"obs/{name}": part for name, part in episode.observations.items()},
        **{f"next_obs/{name}": part for name, part in episode.next_observations.items()},
        **episode.extras,
    }


def layout_of(episode: Episode) -> Layout:
    """Shape of a row and dtype of what all episodes of a data set share.

    Extras are left out, but for ``successes``: models, and so states, may differ.
    """
    return {
        key: (array.shape[1:], array.dtype)
        for key, array in arrays_of(episode).items()
        if key not in episode.extras or key == "successes"
    }


def find_problems(
    episode: Episode, *, layout: Layout | None = None, bounds: Bounds | None = (-1.0, 1.0)
) -> Iterator[tuple[str, str]]:
    """Everything that keeps an episode from being trained on.

    Args:
        episode: to look at.
        layout: of the data set's other episodes.
        bounds: of floating-point actions; ``None`` for any.

    Yields:
        the key and what is wrong with it.

    Example:
        >>> part = np.zeros((4, 3))
        >>> episode = Episode(
        ...     observations={"x": part},
        ...     next_observations={"x": part},
        ...     actions=np.full((4, 7), 2.0),
        ...     rewards=np.zeros(4),
        ...     terminated=np.zeros(4, bool),
        ... )
        >>> list(find_problems(episode))
        [('actions', '2.0 in row 0 is outside [-1.0, 1.0]; the option bounds takes others')]
    """
    arrays = arrays_of(episode)
    # Where one array differs from all others, it is the one at fault, even if it is the actions.
    lengths = Counter(len(array) for array in arrays.values() if array.ndim)
    steps = lengths.most_common(1)[0][0] if lengths else 0
    if steps == 0:
        yield "actions", f"shape {episode.actions.shape}; valid: (T, ...) with at least one step"
        return
    if not episode.observations:
        yield "obs", "no part of an observation; valid: at least one"
    faulty, shared = set(), layout_of(episode)
    for key, array in arrays.items():
        problem = _array_problem(key, array, steps, trained=key in shared)
        if problem is None and layout is not None and key in shared:
            problem = _layout_problem(key, array, layout)
        if problem is not None:
            faulty.add(key)
            yield key, problem
    for key in sorted(set(layout or ()) - set(arrays)):
        yield key, "missing, but other episodes have it"
    for name, part in episode.observations.items():
        after = episode.next_observations.get(name)
        if fault := name_fault(name):
            yield f"obs/{name}", fault
        if after is None:
            yield f"next_obs/{name}", "missing"
        elif (part.shape, part.dtype) != (after.shape, after.dtype) and not (
            faulty & {f"obs/{name}", f"next_obs/{name}"}
        ):
            yield (
                f"next_obs/{name}",
                f"{after.dtype} of shape {after.shape} where obs has {part.dtype} of {part.shape}",
            )
    yield from _flag_problems(episode, steps)
    if bounds is not None and episode.actions.dtype.kind == "f" and episode.actions.ndim:
        yield from _bound_problems(episode.actions, bounds)


def _bound_problems(actions: np.ndarray, bounds: Bounds) -> Iterator[tuple[str, str]]:
    low, high = (np.asarray(bound, dtype=np.float64) for bound in bounds)
    for bound in (low, high):
        if bound.ndim and bound.shape != actions.shape[1:]:
            yield "actions", f"shape {actions.shape}, and bounds of {bound.shape[0]} dimensions"
            return
    slack = ACTION_TOLERANCE * np.maximum(1, np.maximum(np.abs(low), np.abs(high)))
    outside = np.argwhere((actions < low - slack) | (actions > high + slack))
    if len(outside):
        where = tuple(outside[0])
        value = float(actions[where])
        # Infinite ones are reported above.
        if np.isfinite(value):
            valid = list(bounds)
            if low.ndim or high.ndim:
                ends = (np.broadcast_to(bound, actions.shape[1:]) for bound in (low, high))
                valid = [float(end[where[1:]]) for end in ends]
            hint = "" if bounds != (-1.0, 1.0) else "; the option bounds takes others"
            yield "actions", f"{value} in row {where[0]} is outside {valid}{hint}"


def _array_problem(key: str, array: np.ndarray, steps: int, *, trained: bool) -> str | None:
    if array.dtype.kind not in "biuf":
        return f"dtype {array.dtype}; valid: numbers"
    if trained and array.dtype.itemsize > 8:
        return f"dtype {array.dtype}; valid: numbers of at most 64 bits"
    if key in ("rewards", "terminated", "successes") and array.shape != (steps,):
        return f"shape {array.shape}; valid: ({steps},)"
    if array.ndim == 0 or len(array) != steps:
        return f"shape {array.shape}; valid: ({steps}, ...), as many rows as the others"
    if 0 in array.shape:
        return f"shape {array.shape}; valid: rows of at least one number"
    if array.dtype.kind == "f":
        # What trains is float32: larger numbers would be infinite there.
        finite = np.abs(array) <= FLOAT32 if key in ("actions", "rewards") else np.isfinite(array)
        if not finite.all():
            return f"a value that is not finite in row {int(np.argwhere(~finite)[0][0])}"
    return None


def _layout_problem(key: str, array: np.ndarray, layout: Layout) -> str | None:
    if key not in layout:
        return "other episodes do not have it"
    shape, dtype = layout[key]
    if array.shape[1:] != shape:
        expected = ", ".join(map(str, (len(array), *shape)))
        return f"shape {array.shape}; valid: ({expected}), as in the other episodes"
    return None if array.dtype == dtype else f"dtype {array.dtype}; others have {dtype}"


def _flag_problems(episode: Episode, steps: int) -> Iterator[tuple[str, str]]:
    flags = {"terminated": episode.terminated}
    if "successes" in episode.extras:
        flags["successes"] = episode.extras["successes"]
    for key, flag in flags.items():
        # Other shapes and dtypes are reported above.
        if flag.shape == (steps,) and flag.dtype.kind in "biuf":
            wrong = np.flatnonzero((flag != 0) & (flag != 1))
            if len(wrong):
                yield key, f"{flag[wrong[0]]} in row {wrong[0]}; valid: 0 or 1"
            elif key == "terminated" and flag[:-1].any():
                row = int(np.argmax(flag[:-1]))
                yield key, f"terminated in row {row} of {steps}, but the episode goes on"


def check_episode(
    path: str | Path,
    name: str,
    episode: Episode,
    *,
    layout: Layout | None = None,
    bounds: Bounds | None = (-1.0, 1.0),
) -> None:
    """Refuses an episode that :func:`find_problems` finds fault with.

    Args:
        path: file, for the message.
        name: of the episode, for the message.
        episode: to look at.
        layout: of the data set's other episodes.
        bounds: of floating-point actions; ``None`` for any.

    Raises:
        DataError: with the first problem, and how many more there are.
    """
    problems = list(find_problems(episode, layout=layout, bounds=bounds))
    if problems:
        key, message = problems[0]
        if len(problems) > 1:
            message += (
                f" ({len(problems) - 1} more: `python -m torchrl_bmrl.data check` lists them)"
            )
        raise DataError(path, f"{name}/{key}", message)


def check_fps(fps: float) -> None:
    """Refuses a number of steps per second that is none.

    Raises:
        ConfigError: naming the value.
    """
    if not isinstance(fps, int | float) or not 0 < fps < float("inf"):
        raise ConfigError(f"fps is {fps!r}; valid: a positive number")


@dataclass
class Extent:
    """Range of the numbers of an array, in one number for each element of a row.

    Attributes:
        dtype: as text.
        low: smallest of each element.
        high: largest of each element.
        saturated: rows in which each element is at ±1.
    """

    dtype: str
    low: np.ndarray
    high: np.ndarray
    saturated: np.ndarray

    @classmethod
    def of(cls, array: np.ndarray) -> Extent:
        """Range of one episode's array."""
        saturated = (np.abs(array) >= SATURATED).sum(0)
        return cls(str(array.dtype), array.min(0), array.max(0), saturated)

    def include(self, other: Extent) -> None:
        """Widens the range by another episode's."""
        self.low = np.minimum(self.low, other.low)
        self.high = np.maximum(self.high, other.high)
        self.saturated = self.saturated + other.saturated


@dataclass
class Summary:
    """What a data set holds, and everything that is wrong with it.

    Attributes:
        lengths: steps of each whole episode.
        returns: undiscounted sum of rewards of each.
        successes: whether each succeeded at some step; empty where the file does not say.
        failed: names of those that did not.
        account: what was read, and what was left out.
        terminated: episodes that end by termination; the others are truncated.
        ranges: of the actions and of each part of the observation.
        problems: what keeps the data from being trained on: key and message.
        warnings: what may be meant, but deserves a look.
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
    """Looks at every episode; nothing that is wrong stops it.

    Args:
        episodes: by name; reading one may raise a DataError, which becomes a problem.
        prefix: of the names, for messages.
        bounds: of floating-point actions; ``None`` for any.
        account: what is left out already; the episodes are added to it.
        options: by which the episodes are read.
        look: called with every name and its episode, ``None`` where it cannot be read.
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
        _add_ranges(summary, episode)
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
    """Whether each next observation is the following step's observation."""
    return all(
        np.array_equal(episode.next_observations[name][:-1], part[1:])
        for name, part in episode.observations.items()
    )


def _add(summary: Summary, name: str, episode: Episode) -> None:
    summary.account.add(episode)
    summary.lengths.append(len(episode))
    summary.returns.append(float(episode.rewards.sum(dtype=np.float64)))
    summary.terminated += int(episode.terminated[-1])
    if (succeeded := episode.succeeded) is not None:
        summary.successes.append(succeeded)
        summary.failed += [] if succeeded else [name]


def _add_ranges(summary: Summary, episode: Episode) -> None:
    """Includes what can be compared, even where it is out of range, which the ranges then show."""
    for name, array in {"actions": episode.actions, **episode.observations}.items():
        if array.dtype.kind not in "biuf" or not array.ndim or 0 in array.shape:
            continue
        known = summary.ranges.get(name)
        if known is None:
            summary.ranges[name] = Extent.of(array)
        elif np.shape(known.low) == array.shape[1:]:
            known.include(Extent.of(array))


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
            "horizon? A horizon truncates, and values bootstrap through it"
        )
    for key, extent in summary.ranges.items():
        constant = np.flatnonzero(extent.low == extent.high)
        if len(constant):
            yield f"{key}: constant in {_dimensions(constant, extent.low.size)}"
    actions = summary.ranges.get("actions")
    if actions is None or not actions.dtype.startswith("float"):
        return
    share = np.ravel(actions.saturated / max(1, steps))
    # A dimension that is nowhere else has two commands, such as a gripper's.
    for i in np.flatnonzero((share > 0.5) & (share < 1)):
        yield f"actions: dimension {i} is at ±1 in {share[i]:.0%} of all steps"
    if bounds is None and (np.min(actions.low) < -1 or np.max(actions.high) > 1):
        yield "actions: outside [-1, 1]; tell the loss its bounds"


def _dimensions(index: np.ndarray, size: int) -> str:
    if len(index) == size:
        return "every dimension"
    named = ", ".join(map(str, index[:8]))
    return f"dimensions {named}{', ...' if len(index) > 8 else ''} of {size}"


def _repeats(seen: Mapping[str, list[str]]) -> Iterator[str]:
    for names in seen.values():
        if len(names) > 1:
            yield f"the same episode {len(names)} times: {', '.join(names[:8])}"


def _jumps(names: list[str]) -> Iterator[str]:
    if names:
        yield (
            f"next observations are not the following steps' observations in {len(names)} "
            f"episodes, such as {names[0]}: are their steps in order?"
        )
