"""Finds the arrays and the ends of episodes in a file of :mod:`torchrl_bmrl.data.d4rl`'s layout."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from torchrl_bmrl.data.arrays import as_column, as_flags, check_lengths
from torchrl_bmrl.data.hdf5 import has_rows, read_array, read_names, read_node
from torchrl_bmrl.data.robomimic import STEP_KEYS
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs

with needs("data"):
    import h5py

ARRAYS = ("actions", "rewards", "terminals", "timeouts")
BEFORE, AFTER = "observations", "next_observations"
BLOCK = 2**24
"""Number of bytes of an array that are compared at once."""
DEPTH = 6
"""Greatest depth of nested groups that is searched."""


@dataclass(frozen=True, kw_only=True)
class Flat:
    """The arrays of a file, and where its episodes end.

    Attributes:
        steps: N.
        parts: keys of the observation's parts by name.
        after: keys of the same parts of the next observation; empty if there is none.
        rewards: whether the file has rewards.
        terminals: ``(N,)`` bool.
        timeouts: ``(N,)`` bool, if the file has them.
        ends: ``(N,)`` bool: last rows of episodes.
        ended: whether the file marks its last row as an end.
        extras: keys of further arrays of N rows by name.
        left_alone: keys of what is not read.
    """

    steps: int
    parts: Mapping[str, str]
    after: Mapping[str, str]
    rewards: bool
    terminals: np.ndarray
    timeouts: np.ndarray | None
    ends: np.ndarray
    ended: bool
    extras: Mapping[str, str]
    left_alone: tuple[str, ...]

    def episodes(self) -> list[slice]:
        """Rows of each episode."""
        stops = (np.flatnonzero(self.ends) + 1).tolist()
        return [slice(start, stop) for start, stop in zip([0, *stops], stops, strict=False)]

    @classmethod
    def of(cls, path: str | Path, file: h5py.File, horizon: int | None) -> Flat:
        """Inspects a file without reading its large arrays."""
        present = read_names(path, file, "/")
        parts, beside = _find_parts(path, file, BEFORE)
        after: dict[str, str] = {}
        if AFTER in present:
            found, further = _find_parts(path, file, AFTER)
            after = {part: found.get(part, f"{AFTER}/{part}") for part in parts}
            beside += [*further, *(found[part] for part in found if part not in parts)]
        keys = ["actions", "terminals", *parts.values(), *after.values()]
        keys += [key for key in ("rewards", "timeouts") if key in present]
        steps = _check_lengths(path, file, keys)
        # Every step may end an episode, and no step of real numbers takes less than a byte.
        if steps > 2**12 + os.path.getsize(path):
            raise DataError(path, "actions", f"claims {steps} steps, more than the file can hold")
        for part in after:
            _check_alike(path, file, parts[part], after[part])
        extras, further = _find_extras(path, file, present, steps)
        terminals = _read_flags(path, file, "terminals")
        timeouts = _read_flags(path, file, "timeouts") if "timeouts" in present else None
        flat = cls(
            steps=steps,
            parts=parts,
            after=after,
            rewards="rewards" in present,
            terminals=terminals,
            timeouts=timeouts,
            ends=terminals,
            ended=True,
            extras=extras,
            left_alone=(*beside, *further),
        )
        ends = _find_ends(path, file, flat, horizon)
        last = np.arange(steps) == steps - 1
        return replace(flat, ends=ends | last, ended=bool(ends[-1]))


def _find_ends(path: str | Path, file: h5py.File, flat: Flat, horizon: int | None) -> np.ndarray:
    """Whether each row is the last of its episode."""
    if horizon is not None:
        if type(horizon) is not int or horizon < 1:
            raise ConfigError(f"horizon is {horizon!r}; valid: 1 and more, None")
        if flat.timeouts is not None:
            raise ConfigError(f"horizon is {horizon}, but {path} has timeouts; valid: None")
        rows = np.arange(flat.steps)
        # For each row, the row after the last terminal before it.
        first = np.maximum.accumulate(np.where(np.roll(flat.terminals, 1), rows, 0))
        return flat.terminals | ((rows - first) % horizon == horizon - 1)
    if flat.timeouts is not None:
        return flat.terminals | flat.timeouts
    valid = "valid: timeouts (N,), or a horizon, the longest episode's steps"
    if not flat.after:
        message = f"missing, and so is {AFTER}: it is unknown where episodes were cut"
        raise DataError(path, "timeouts", f"{message}; {valid}")
    jumps = find_jumps(path, file, flat)
    inner = flat.terminals[:-1]
    if inner.any() and not jumps[:-1].any():
        row = int(np.flatnonzero(inner)[0])
        message = (
            f"row {row} is the next row's observation although row {row} is terminal: the array "
            "was made by shifting and does not show where episodes were cut"
        )
        raise DataError(path, AFTER, f"{message}; {valid}")
    jumps[-1] = False  # unknown: there is no next row
    return flat.terminals | jumps


def find_jumps(path: str | Path, file: h5py.File, flat: Flat) -> np.ndarray:
    """Whether each row's next observation differs from the next row; true for the last row."""
    jumps = np.arange(flat.steps) == flat.steps - 1
    for part, key in flat.parts.items():
        node = read_node(path, file, key)
        rows = max(1, BLOCK * flat.steps // max(1, node.nbytes))
        for start in range(0, flat.steps - 1, rows):
            stop = min(start + rows, flat.steps - 1)
            after = read_array(path, file, flat.after[part], slice(start, stop))
            follows = read_array(path, file, key, slice(start + 1, stop + 1))
            jumps[start:stop] |= (after != follows).reshape(stop - start, -1).any(axis=1)
    return jumps


def _find_parts(path: str | Path, file: h5py.File, key: str) -> tuple[dict[str, str], list[str]]:
    """Keys of the observation's parts by name, and keys of other arrays beside them."""
    node = read_node(path, file, key)
    if not isinstance(node, h5py.Group):
        return {"observation": key}, []
    parts, beside = {}, []
    for part in read_names(path, file, key):
        node = read_node(path, file, f"{key}/{part}")
        if node is None or (isinstance(node, h5py.Dataset) and node.dtype.kind not in "OSU"):
            parts[part] = f"{key}/{part}"
        else:
            beside.append(f"{key}/{part}")
    if not parts:
        raise DataError(path, key, "no part of the observation; valid: at least one")
    return parts, beside


def _find_extras(
    path: str | Path, file: h5py.File, present: list[str], steps: int
) -> tuple[dict[str, str], list[str]]:
    """Keys of further arrays with a row for each step by name, and keys of those not read."""
    extras: dict[str, str] = {}
    beside = []
    known = {BEFORE, AFTER, *ARRAYS}
    keys: list[str] = []
    for key in present:
        if key in ("infos", "metadata") and isinstance(read_node(path, file, key), h5py.Group):
            keys += walk(path, file, key) if key == "infos" else []
        elif key not in known:
            keys.append(key)
    # Arrays below infos take precedence over others with the same name.
    for key in sorted(keys, key=lambda key: not key.startswith("infos/")):
        name = key.removeprefix("infos/").replace("/", "_")
        name = "successes" if name == "success" else name
        if name == "successes" and name not in extras:
            _check_lengths(path, file, [key], steps)
        if name in extras or name in STEP_KEYS or not has_rows(read_node(path, file, key), steps):
            beside.append(key)
        else:
            extras[name] = key
    return extras, beside


def walk(path: str | Path, file: h5py.File, key: str) -> Iterator[str]:
    """Keys of all datasets below a group, and of groups deeper than the limit (circular links).

    Raises:
        DataError: for links to another file, and for damaged nodes.
    """
    for name in read_names(path, file, key):
        where = f"{key}/{name}"
        node = read_node(path, file, where)
        if isinstance(node, h5py.Group) and where.count("/") < DEPTH:
            yield from walk(path, file, where)
        else:
            yield where


def _check_lengths(
    path: str | Path, file: h5py.File, keys: list[str], steps: int | None = None
) -> int:
    """Rows that the arrays have in common; without ``steps``, as many as most of them have."""
    shapes = {}
    for key in keys:
        node = read_node(path, file, key)
        if not isinstance(node, h5py.Dataset):
            raise DataError(path, key, "missing" if node is None else "a group; valid: a dataset")
        shapes[key] = node.shape
    return check_lengths(path, "", shapes, steps=steps)


def _check_alike(path: str | Path, file: h5py.File, before: str, after: str) -> None:
    one, other = read_node(path, file, before), read_node(path, file, after)
    kinds = one.dtype.newbyteorder("="), other.dtype.newbyteorder("=")
    if one.shape != other.shape or kinds[0] != kinds[1]:
        message = f"{other.dtype} of shape {other.shape}; valid: {one.dtype} of {one.shape}"
        raise DataError(path, after, f"{message}, as {before}")


def _read_flags(path: str | Path, file: h5py.File, key: str) -> np.ndarray:
    flags = as_column(path, key, read_array(path, file, key))
    return as_flags(path, key, flags)
