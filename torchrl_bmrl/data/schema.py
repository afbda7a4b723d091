"""Checks episodes before anything trains on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchrl_bmrl.data.episodes import Episode, name_fault
from torchrl_bmrl.data.options import Bounds
from torchrl_bmrl.errors import ConfigError, DataError

ACTION_TOLERANCE = 1e-6
MAX_FPS = 1e9
"""Larger numbers are not rates, and may not fit a float."""
FLOAT32 = float(np.finfo(np.float32).max)

Layout = dict[str, tuple[tuple[int, ...], np.dtype]]


def arrays_of(episode: Episode) -> dict[str, np.ndarray]:
    """All arrays of an episode by their keys in robomimic's layout."""
    return {
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminated": episode.terminated,
        **{f"obs/{name}": part for name, part in episode.observations.items()},
        **{f"next_obs/{name}": part for name, part in episode.next_observations.items()},
        **episode.extras,
    }


def layout_of(episode: Episode) -> Layout:
    """Shape of a row and dtype of each array that must be alike in all episodes of a data set.

    Extras other than ``successes`` are not included, because models, and so states, may differ.
    """
    return {
        key: (array.shape[1:], array.dtype)
        for key, array in arrays_of(episode).items()
        if key not in episode.extras or key == "successes"
    }


def find_problems(
    episode: Episode, *, layout: Layout | None = None, bounds: Bounds | None = (-1.0, 1.0)
) -> Iterator[tuple[str, str]]:
    """Finds all faults that keep an episode from being trained on.

    Args:
        episode: to check.
        layout: of the data set's other episodes.
        bounds: of floating-point actions; ``None`` for any.

    Yields:
        key and description of each fault.
    """
    arrays = arrays_of(episode)
    # If one array differs from all others, it is at fault, even if it is the actions.
    lengths = Counter(len(array) for array in arrays.values() if array.ndim)
    steps = lengths.most_common(1)[0][0] if lengths else 0
    if steps == 0:
        yield "actions", f"shape {episode.actions.shape}; valid: (T, ...) with at least one step"
        return
    if not episode.observations:
        yield "obs", "no part of the observation; valid: at least one"
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
            size = bound.shape[0]
            problem = f"shape {actions.shape}; valid: (T, {size}), the size of the bounds"
            yield "actions", problem
            return
    slack = ACTION_TOLERANCE * np.maximum(1, np.maximum(np.abs(low), np.abs(high)))
    outside = np.argwhere((actions < low - slack) | (actions > high + slack))
    if len(outside):
        where = tuple(outside[0])
        value = float(actions[where])
        # Infinite values are reported above.
        if np.isfinite(value):
            valid = list(bounds)
            if low.ndim or high.ndim:
                ends = (np.broadcast_to(bound, actions.shape[1:]) for bound in (low, high))
                valid = [float(end[where[1:]]) for end in ends]
            hint = "" if bounds != (-1.0, 1.0) else "; the option bounds sets others"
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
        finite = np.isfinite(array)
        if not finite.all():
            return f"a value that is not finite in row {int(np.argwhere(~finite)[0][0])}"
        if trained and np.any(large := np.abs(array) > FLOAT32):
            value, row = array[large].flat[0], int(np.argwhere(large)[0][0])
            return f"{value:g} in row {row}; valid: at most {FLOAT32:.2g}, as in float32"
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
    """Refuses an episode with faults that :func:`find_problems` finds.

    Args:
        path: file, for the message.
        name: of the episode, for the message.
        episode: to check.
        layout: of the data set's other episodes.
        bounds: of floating-point actions; ``None`` for any.

    Raises:
        DataError: naming the first fault and the number of others.
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
    """Refuses an invalid number of steps per second.

    Raises:
        ConfigError: naming the value.
    """
    if not isinstance(fps, int | float) or not 0 < fps < MAX_FPS:
        raise ConfigError(f"fps is {fps!r}; valid: a positive number below {MAX_FPS:g}")
