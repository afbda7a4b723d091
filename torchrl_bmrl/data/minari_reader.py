"""The reading half of :mod:`torchrl_bmrl.data.minari`, where the layout is described."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.arrays import as_flags, check_finite
from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.hdf5 import (
    DAMAGE,
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
    main_file,
    metadata_file,
    read_rows,
    read_spaces,
)
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import RawEpisode, complete
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
def open_raw(path: str | os.PathLike[str]) -> Iterator[Mapping[str, RawEpisode]]:
    """Opens a data set, written here or by Minari; an episode is read when it is asked for.

    Observations without names are read as the part ``observation``. Where neither flag is set at
    the end, the episode was cut, which is a truncation. The info ``success`` becomes the extra
    ``successes``; every other array of numbers among the infos keeps its name and, of T + 1 rows,
    loses the last. Parts that are neither numbers nor named once (texts, tuples, dictionaries in
    dictionaries), nested infos, and what else lies there are left alone, and named in
    ``left_alone``.

    Args:
        path: the data set's folder, which holds ``data/main_data.hdf5`` and ``data/metadata.json``.

    Yields:
        the episodes as ``episode_0``, ``episode_1``, ...; to be read inside the block.

    Raises:
        DataError: naming file and key, for a file that is missing, damaged or a git-LFS pointer, a
            missing key, a wrong number of rows, rows that are not of their space, observations
            without a part of numbers, or an end inside an episode. What concerns one episode is
            raised when that is read.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data.minari import write_episodes
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "sawyer" / "lift-v0"
        >>> write_episodes(path, [episode])
        >>> with open_raw(path) as episodes:
        ...     {name: raw.observations["x"].shape for name, raw in episodes.items()}
        {'episode_0': (6, 3)}
    """
    spaces = read_spaces(path)
    hdf5 = main_file(path)
    with open_file(hdf5) as file:
        names, _ = _episode_names(hdf5, file)

        def read(name: str) -> RawEpisode:
            return _read_episode(hdf5, file, name, spaces)

        yield LazyEpisodes(names, read)


@contextmanager
def open_episodes(path: str | os.PathLike[str]) -> Iterator[Mapping[str, Episode]]:
    """Opens a data set like :func:`open_raw`, whose episodes lack nothing.

    Args:
        path: the data set's folder.

    Yields:
        the episodes as ``episode_0``, ``episode_1``, ...; to be read inside the block.

    Raises:
        DataError: as :func:`open_raw`, and for an episode without rewards.
    """
    hdf5 = main_file(path)
    with open_raw(path) as episodes:

        def read(name: str) -> Episode:
            return complete(hdf5, name, episodes[name], ReadOptions())

        yield LazyEpisodes(episodes, read)


def read_metadata(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What ``metadata.json`` says of a data set.

    Returns:
        its entries and, where the actions' space is a finite box of floating-point numbers,
        ``action_bounds``: ``low`` and ``high``, a number each or, where the dimensions differ, one
        for each of them.

    Raises:
        DataError: naming file and key, if it is missing, damaged, or has no spaces.
    """
    spaces = read_spaces(path)
    metadata: dict[str, Any] = json.loads(metadata_file(path).read_bytes())
    metadata.pop("action_bounds", None)
    bounds = spaces.actions.bounds
    return metadata if bounds is None else {**metadata, "action_bounds": bounds}


def find_oddities(path: str | os.PathLike[str]) -> list[str]:
    """What deserves a look in a data set beside its episodes: warnings.

    Among them is whatever an attribute or ``metadata.json`` says and the arrays contradict; the
    arrays are believed.

    Raises:
        DataError: if the data set cannot be opened.
    """
    spaces = read_spaces(path)
    hdf5 = main_file(path)
    with open_file(hdf5) as file:
        names, beside = _episode_names(hdf5, file)
        found: dict[str, list[str]] = {}
        steps = 0
        for name in names:
            try:
                count = len(file[f"{name}/actions"])
                attributes = read_attributes(hdf5, file, name)
                for key, value in (("id", _number(name)), ("total_steps", count)):
                    if (told := attributes.get(key, value)) != value:
                        message = f"the attribute {key} contradicts name and arrays"
                        where = f"{name} ({told!r}, not {value})"
                        found.setdefault(message, []).append(where)
                for key, message in _storage_oddities(hdf5, file, name, spaces):
                    found.setdefault(f"{key}: {message}", []).append(name)
                steps += count
            except (DataError, *DAMAGE):
                continue  # whoever reads the episode says what is wrong with it
    oddities = []
    if beside:
        oddities.append(f"beside the episodes, left alone: {', '.join(map(repr, beside))}")
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
    """How arrays are kept in an episode that may change their numbers: key and message."""
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
                yield f"infos/{info}", "stored as JPEG, and left alone"


def _episode_names(path: Path, file: h5py.File) -> tuple[list[str], list[str]]:
    """Names of the episodes, and of what lies beside them."""
    names = read_names(path, file, "/")
    episodes = [name for name in names if _EPISODE.fullmatch(name)]
    if not episodes:
        raise DataError(path, None, "no episodes; valid: at least episode_0")
    return episodes, [name for name in names if not _EPISODE.fullmatch(name)]


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
    steps = _check_lengths(path, name, arrays)
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


def _check_lengths(path: Path, name: str, arrays: Mapping[str, np.ndarray]) -> int:
    """Steps of an episode, in which its arrays agree before anything is cut."""
    more = {key: int(key.startswith("observations")) for key in arrays}
    for key, array in arrays.items():
        if not array.ndim:
            raise DataError(path, f"{name}/{key}", "one number; valid: a row for each step")
    # Where one array differs from all others, it is the one at fault, even if it is the actions.
    steps = Counter(len(array) - more[key] for key, array in arrays.items()).most_common(1)[0][0]
    for key, array in arrays.items():
        if key == "rewards" and array.ndim > 1:
            raise DataError(path, f"{name}/{key}", f"shape {array.shape}; valid: ({steps},)")
        if len(array) != steps + more[key]:
            message = f"shape {array.shape}; valid: {steps + more[key]} rows"
            raise DataError(path, f"{name}/{key}", f"{message}, since most arrays are of {steps}")
    if steps < 1:
        message = f"shape {arrays['actions'].shape}; valid: at least one row"
        raise DataError(path, f"{name}/actions", message)
    return steps


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
    """Arrays with a row for each step, and keys of what is left alone."""
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
        elif info not in (*STEP_KEYS, "successes") and _has_rows(node, steps):
            extras[info] = read_array(path, file, key)[:steps]
        else:
            beside.append(f"infos/{info}")
    return extras, beside


def _has_rows(node: Any, steps: int) -> bool:
    """Whether it has a row of numbers for each step, or for each observation."""
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "biuf" or is_jpeg(node):
        return False
    return bool(node.size) and len(node.shape) > 0 and node.shape[0] in (steps, steps + 1)
