"""Reads Minari data sets; :mod:`torchrl_bmrl.data.minari` describes the layout and writes it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from torchrl_bmrl.data.arrays import as_flags, check_finite, check_lengths
from torchrl_bmrl.data.episodes import LazyEpisodes
from torchrl_bmrl.data.hdf5 import (
    DAMAGE,
    has_rows,
    open_file,
    read_array,
    read_attributes,
    read_names,
    read_node,
)
from torchrl_bmrl.data.minari_spaces import (
    Space,
    Spaces,
    is_jpeg,
    read_rows,
    read_spaces,
)
from torchrl_bmrl.data.raw import Opened, RawEpisode
from torchrl_bmrl.data.robomimic import STEP_KEYS
from torchrl_bmrl.data.schema import ACTION_TOLERANCE
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs

with needs("data"):
    import h5py

OWN_ATTRIBUTES = ("id", "total_steps")
_FLAGS = ("terminations", "truncations")
_ARRAYS = ("observations", "actions", "rewards", *_FLAGS, "infos")
_EPISODE = re.compile(r"episode_(0|[1-9]\d*)")


@contextmanager
def open_data(path: str | os.PathLike[str]) -> Iterator[Opened]:
    """Opens a data set that was written here or by Minari; each episode is read on access.

    Observations without names are read as the part ``observation``. An episode with neither flag
    set at its end was cut, which is a truncation. The info ``success`` becomes the extra
    ``successes``; every other array of numbers among the infos keeps its name and, if it has T + 1
    rows, loses the last. Texts, tuples, nested dictionaries and nested infos are not read, but
    listed in ``left_alone``.

    Args:
        path: the data set's folder, with ``data/main_data.hdf5`` and ``data/metadata.json``.

    Yields:
        the episodes as ``episode_0``, ``episode_1``, ...; the entries of ``metadata.json``, with
        ``action_bounds`` (``low`` and ``high``, a number each or a list with one for each
        dimension) if the space of the actions is a finite box of floating-point numbers; and
        oddities, among them contradictions between the metadata and the arrays, of which the arrays
        are used.

    Raises:
        DataError: naming file and key, for a missing or damaged file, a git-LFS pointer, a missing
            key, a wrong number of rows, rows outside their space, observations without a part of
            numbers, or an end inside an episode. Faults of one episode are raised when it is read.
    """
    spaces = read_spaces(path)
    metadata = {key: value for key, value in spaces.metadata.items() if key != "action_bounds"}
    if (bounds := spaces.actions.bounds) is not None:
        metadata["action_bounds"] = bounds
    hdf5 = Path(path) / "data" / "main_data.hdf5"
    with open_file(hdf5) as file:
        names = read_names(hdf5, file, "/")
        episodes = [name for name in names if _EPISODE.fullmatch(name)]
        if not episodes:
            raise DataError(hdf5, None, "no episodes; valid: at least episode_0")
        beside = [name for name in names if not _EPISODE.fullmatch(name)]

        def read(name: str) -> RawEpisode:
            return _read_episode(hdf5, file, name, spaces)

        yield Opened(
            episodes=LazyEpisodes(episodes, read),
            metadata=metadata,
            oddities=_oddities(hdf5, file, episodes, beside, spaces),
        )


def _oddities(
    path: Path, file: h5py.File, names: list[str], beside: list[str], spaces: Spaces
) -> list[str]:
    found: dict[str, list[str]] = {}
    steps = 0
    for name in names:
        try:
            count = len(read_node(path, file, f"{name}/actions"))
            attributes = read_attributes(path, file, name)
            for key, value in (("id", _number(name)), ("total_steps", count)):
                if (told := attributes.get(key, value)) != value:
                    message = f"the attribute {key} contradicts name and arrays"
                    where = f"{name} ({told!r}, not {value})"
                    found.setdefault(message, []).append(where)
            for key, message in _storage_oddities(path, file, name, spaces):
                found.setdefault(f"{key}: {message}", []).append(name)
            steps += count
        except (DataError, *DAMAGE):
            continue  # reported when the episode is read
    oddities = []
    if beside:
        oddities.append(f"beside the episodes, not read: {', '.join(map(repr, beside))}")
    numbers = set(map(_number, names))
    if gaps := sorted(set(range(max(numbers))) - numbers):
        oddities.append(f"{len(gaps)} episodes are missing, such as episode_{gaps[0]}")
    for key, value in (("total_episodes", len(names)), ("total_steps", steps)):
        told = spaces.metadata.get(key, value)
        if told != value:
            oddities.append(f"{key} is {told!r} in metadata.json, the arrays have {value}")
    for message, places in found.items():
        oddities.append(f"{message} in {len(places)} episodes, such as {places[0]}")
    return oddities


def _storage_oddities(
    path: Path, file: h5py.File, name: str, spaces: Spaces
) -> Iterator[tuple[str, str]]:
    """Ways of storing an episode's arrays that may have changed their numbers: key and message."""
    for key, space in {**spaces.parts, "actions": spaces.actions}.items():
        node = read_node(path, file, f"{name}/{key}")
        if not isinstance(node, h5py.Dataset):
            continue
        if is_jpeg(node):
            yield key, "stored as JPEG, which loses bits"
        elif space.dtype.kind == "f" and node.dtype.kind != "f":
            yield key, f"{node.dtype}, though its space is of {space.dtype}"
    if isinstance(read_node(path, file, f"{name}/infos"), h5py.Group):
        for info in read_names(path, file, f"{name}/infos"):
            node = read_node(path, file, f"{name}/infos/{info}")
            if isinstance(node, h5py.Dataset) and is_jpeg(node):
                yield f"infos/{info}", "stored as JPEG, and not read"


def _number(name: str) -> int:
    return int(name.removeprefix("episode_"))


def _read_episode(path: Path, file: h5py.File, name: str, spaces: Spaces) -> RawEpisode:
    present = read_names(path, file, name)
    arrays = {"actions": read_rows(path, file, f"{name}/actions", spaces.actions, exact=True)}
    for key in ("rewards", *_FLAGS):
        if key != "rewards" or key in present:
            arrays[key] = read_array(path, file, f"{name}/{key}")
    for key, space in spaces.parts.items():
        arrays[key] = read_rows(path, file, f"{name}/{key}", space)
        check_finite(path, f"{name}/{key}", arrays[key])
    more = tuple(key for key in arrays if key.startswith("observations"))
    shapes = {key: array.shape for key, array in arrays.items()}
    steps = check_lengths(path, f"{name}/", shapes, one_more=more)
    if len(shapes.get("rewards", ())) > 1:
        message = f"shape {shapes['rewards']}; valid: ({steps},)"
        raise DataError(path, f"{name}/rewards", message)
    if spaces.actions.bounds is None:
        _check_range(path, f"{name}/actions", arrays["actions"], spaces.actions)
    ends = {flag: _flags(path, f"{name}/{flag}", arrays[flag]) for flag in _FLAGS}
    for flag, rows in ends.items():
        for row in np.flatnonzero(rows[:-1]):
            message = f"set in row {row} of {steps}; valid: in the last only"
            raise DataError(path, f"{name}/{flag}", message)
    parts = {key.partition("/")[2] or "observation": arrays[key] for key in spaces.parts}
    extras, beside = _read_infos(path, file, name, steps) if "infos" in present else ({}, [])
    beside = [key for key in present if key not in _ARRAYS] + beside
    if "observations" not in spaces.parts:
        held = (f"observations/{part}" for part in read_names(path, file, f"{name}/observations"))
        beside += [key for key in held if key not in spaces.parts]
    attributes = read_attributes(path, file, name)
    return RawEpisode(
        observations=parts,
        actions=arrays["actions"],
        rewards=arrays.get("rewards"),
        terminated=ends["terminations"],
        extras=extras,
        attributes={key: x for key, x in attributes.items() if key not in OWN_ATTRIBUTES},
        left_alone=tuple(beside),
    )


def _flags(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    if array.ndim != 1:
        raise DataError(path, key, f"shape {array.shape}; valid: ({len(array)},)")
    return as_flags(path, key, array)


def _check_range(path: Path, key: str, actions: np.ndarray, space: Space) -> None:
    slack = ACTION_TOLERANCE if actions.dtype.kind == "f" else 0
    outside = np.argwhere((actions < space.low - slack) | (actions > space.high + slack))
    for where in map(tuple, outside):
        ends = [end[where[1:]].item() for end in (space.low, space.high)]
        message = f"{actions[where]} in row {where[0]} is outside {ends}, its space"
        raise DataError(path, key, message)


def _read_infos(
    path: Path, file: h5py.File, name: str, steps: int
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays with a row for each step, and keys of infos that are not read."""
    extras: dict[str, np.ndarray] = {}
    beside = []
    infos = read_names(path, file, f"{name}/infos")
    flags = "success" if "success" in infos else "successes"
    for info in infos:
        key = f"{name}/infos/{info}"
        node = read_node(path, file, key)
        if info == flags:
            array = read_array(path, file, key)
            if array.shape not in ((steps,), (steps + 1,)):
                valid = f"{steps} or {steps + 1} rows of one number"
                raise DataError(path, key, f"shape {array.shape}; valid: {valid}")
            _flags(path, key, array)
            # Row t + 1 comes after step t.
            extras["successes"] = array[-steps:]
        elif (
            info not in (*STEP_KEYS, "successes")
            and has_rows(node, steps, steps + 1)
            and not is_jpeg(node)
        ):
            extras[info] = read_array(path, file, key)[:steps]
        else:
            beside.append(f"infos/{info}")
    return extras, beside
