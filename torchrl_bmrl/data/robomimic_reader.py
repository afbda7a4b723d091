"""Reads demonstrations in robomimic's HDF5 layout, and in the variants that other tools write.

MimicGen, LIBERO, RoboCasa and Isaac Lab write the same layout with additions and omissions: no
``next_obs``, no ``rewards``, an attribute ``success`` instead of an array, groups below ``obs``.
Parts that this library does not use are not read, but listed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.arrays import as_flags, check_finite
from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.hdf5 import (
    DAMAGE,
    open_file,
    read_array,
    read_attribute,
    read_attributes,
    read_names,
    read_node,
)
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import Opened, RawEpisode, complete
from torchrl_bmrl.data.robomimic_file import (
    episode_names,
    find_mask_problems,
    find_oddities,
    metadata_of,
)
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs

with needs("data"):
    import h5py

STEP_KEYS = ("actions", "rewards", "dones", "terminated", "obs", "next_obs")


@contextmanager
def open_episodes(
    path: str | Path,
    *,
    extras: Iterable[str] | None = None,
    attributes: bool = True,
    **options: Any,
) -> Iterator[Mapping[str, Episode]]:
    """Opens a file's episodes by name; each is read on access.

    Files without ``next_obs`` take the next step's ``obs``, and the last row of ``obs`` if it has
    one row more than there are actions. Otherwise ``last_step`` decides about the last step.

    Args:
        path: the HDF5 file; it is only read.
        extras: further arrays to read if present; ``None`` for all with a row of numbers for each
            step.
        attributes: whether to read the attributes of the demonstrations.
        options: ``split``, ``observation_keys``, ``dones_terminate``, ``last_step`` and ``reward``
            of :class:`~torchrl_bmrl.data.options.ReadOptions`. The other options have no effect
            here.

    Raises:
        DataError: naming file and key, for a missing or damaged file, for a mask that is missing or
            names a missing demonstration, and, when an episode is read, for missing keys.
        ConfigError: for invalid options.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "lift.hdf5"
        >>> write_episodes(path, [episode] * 3, env_args={}, masks={"valid": [2]})
        >>> with open_episodes(path, split="valid") as episodes:
        ...     {name: len(episode) for name, episode in episodes.items()}
        {'demo_2': 5}
    """
    chosen = ReadOptions(**options)
    with open_file(path) as file:
        raw = _episodes(path, file, chosen, extras, attributes)

        def read(name: str) -> Episode:
            return complete(path, f"data/{name}", raw[name], chosen)

        yield LazyEpisodes(raw, read)


@contextmanager
def open_data(
    path: str | Path,
    options: ReadOptions,
    *,
    to_train: bool = False,
    file: h5py.File | None = None,
) -> Iterator[Opened]:
    """Opens a file; each episode is read on access, as the file stores it.

    Args:
        path: the HDF5 file; it is only read.
        options: see :func:`open_episodes`.
        to_train: whether to skip the episodes' attributes and all extras except ``successes``.
        file: the same file if it is open already.

    Raises:
        DataError: as :func:`open_episodes`.
    """
    extras = ("successes",) if to_train else None
    with nullcontext(file) if file else open_file(path) as file:
        yield Opened(
            episodes=_episodes(path, file, options, extras, not to_train),
            metadata=metadata_of(path, file),
            prefix="data/",
            problems=list(find_mask_problems(path, file)),
            oddities=list(find_oddities(path, file)),
        )


def _episodes(
    path: str | Path,
    file: h5py.File,
    options: ReadOptions,
    extras: Iterable[str] | None,
    attributes: bool,
) -> Mapping[str, RawEpisode]:
    wanted = None if extras is None else set(extras)
    names = episode_names(path, file, options.split)
    # Found when the first episode is read, because it takes a look at all of them.
    foreign: list[set[str]] = []

    def read(name: str) -> RawEpisode:
        if options.observation_keys is None and not foreign:
            foreign.append(_foreign_parts(path, file, names))
        known = foreign[0] if foreign else set()
        return _read_raw(path, file, f"data/{name}", options, known, wanted, attributes)

    return LazyEpisodes(names, read)


def _foreign_parts(path: str | Path, file: h5py.File, names: list[str]) -> set[str]:
    """Names below ``obs`` that are arrays of numbers in no episode, such as groups and texts."""
    found: dict[str, bool] = {}
    for name in names:
        key = f"data/{name}/obs"
        if isinstance(read_node(path, file, key), h5py.Group):
            for part in read_names(path, file, key):
                found[part] = found.get(part) or _is_numbers(path, file, f"{key}/{part}")
    return {part for part, numbers in found.items() if not numbers}


def _is_numbers(path: str | Path, file: h5py.File, key: str) -> bool:
    """Whether a node is neither a group nor text."""
    node = read_node(path, file, key)
    if node is None:  # damaged: reported when it is read
        return True
    return isinstance(node, h5py.Dataset) and node.dtype.kind not in "OSU"


def _read_raw(
    path: str | Path,
    file: h5py.File,
    demo: str,
    options: ReadOptions,
    foreign: set[str],
    extras: set[str] | None,
    attributes: bool,
) -> RawEpisode:
    present = read_names(path, file, demo)
    parts, beside = _parts(path, file, f"{demo}/obs", options, foreign)
    observations = {part: read_array(path, file, key) for part, key in parts.items()}
    steps = {"actions": read_array(path, file, f"{demo}/actions")}
    if not steps["actions"].ndim:
        raise DataError(path, f"{demo}/actions", "one number; valid: (T, action_dim)")
    if "rewards" in present:
        steps["rewards"] = _read_column(path, file, f"{demo}/rewards")
    if "terminated" in present:
        steps["terminated"] = _read_flags(path, file, f"{demo}/terminated")
    elif options.dones_terminate:
        steps["dones"] = _read_flags(path, file, f"{demo}/dones")
    after = None
    if "next_obs" in present:
        after = {part: read_array(path, file, _next(key)) for part, key in parts.items()}
        beside += _not_read(path, file, f"{demo}/next_obs", parts)
    if "successes" in present and (extras is None or "successes" in extras):
        steps["successes"] = _read_column(path, file, f"{demo}/successes")
        as_flags(path, f"{demo}/successes", steps["successes"])  # checked only
    if after is None:
        # The next observations are made of these rows, so errors name the rows of the file.
        for part, key in parts.items():
            check_finite(path, key, observations[part])
        _check_lengths(path, demo, steps, observations, _rows_of_dones(path, file, demo))
    elif "dones" in steps and steps["dones"].shape != steps["actions"].shape[:1]:
        message = f"shape {steps['dones'].shape}; valid: {steps['actions'].shape[:1]}"
        raise DataError(path, f"{demo}/dones", message)
    further = {"successes": steps["successes"]} if "successes" in steps else {}
    for key in present:
        if key in STEP_KEYS or key in further:
            continue
        if (extras is None or key in extras) and _has_rows(
            path, file, f"{demo}/{key}", len(steps["actions"])
        ):
            further[key] = read_array(path, file, f"{demo}/{key}")
        elif extras is None:
            beside.append(key)
    if attributes:
        told = read_attributes(path, file, demo)
        told.pop("num_samples", None)
    else:
        success = read_attribute(path, file, demo, "success")
        told = {} if success is None else {"success": success}
    return RawEpisode(
        observations=observations,
        next_observations=after,
        actions=steps["actions"],
        rewards=steps.get("rewards"),
        terminated=steps.get("terminated"),
        dones=steps.get("dones"),
        extras=further,
        attributes=told,
        left_alone=tuple(beside),
    )


def _parts(
    path: str | Path, file: h5py.File, key: str, options: ReadOptions, foreign: set[str]
) -> tuple[dict[str, str], list[str]]:
    """Keys of the observation's parts by name, and names of parts that are not read."""
    if isinstance(read_node(path, file, key), h5py.Dataset):  # Isaac Lab: all terms in one array
        valid = {"observation": key}
    else:
        valid = {part: f"{key}/{part}" for part in read_names(path, file, key)}
    if options.observation_keys is None:
        chosen = {part: where for part, where in valid.items() if part not in foreign}
        return chosen, [f"obs/{part}" for part in valid if part in foreign]
    for part in options.observation_keys:
        if part not in valid:
            raise DataError(path, f"{key}/{part}", f"missing; valid: {', '.join(valid)}")
    # Parts left out on request are not reported.
    return {part: valid[part] for part in options.observation_keys}, []


def _next(key: str) -> str:
    demo, _, part = key.partition("/obs")
    return f"{demo}/next_obs{part}"


def _not_read(path: str | Path, file: h5py.File, key: str, parts: Mapping[str, str]) -> list[str]:
    """Names below ``next_obs`` that are not below ``obs``."""
    if not isinstance(read_node(path, file, key), h5py.Group):
        return []
    before = key.replace("/next_obs", "/obs")
    known = {*parts, *read_names(path, file, before)}
    return [f"next_obs/{part}" for part in read_names(path, file, key) if part not in known]


def _check_lengths(
    path: str | Path,
    demo: str,
    steps: Mapping[str, np.ndarray],
    observations: Mapping[str, np.ndarray],
    others: list[int],
) -> None:
    """Compares the lengths of an episode's arrays if it has no ``next_obs``.

    Args:
        path: file, for the message.
        demo: key of the episode, for the message.
        steps: arrays of T rows.
        observations: arrays of T or T + 1 rows.
        others: numbers of rows of arrays that are not read, and should be T.

    Raises:
        DataError: naming an array whose number of rows differs from that of most others.
    """
    keys = {**steps, **{f"obs/{part}": array for part, array in observations.items()}}
    for key, array in keys.items():
        if not array.ndim:
            raise DataError(path, f"{demo}/{key}", "one number; valid: a row for each step")
        if key in steps and key != "actions" and array.ndim > 1:
            raise DataError(path, f"{demo}/{key}", f"shape {array.shape}; valid: ({len(array)},)")
    rows = [len(array) for array in observations.values()]
    # Observations come before each action, and in some files also after the last.
    likely = Counter([*(len(array) for array in steps.values()), *others])
    count = max(likely, key=lambda n: (likely[n], rows.count(n), rows.count(n + 1)))
    longer = bool(rows) and rows.count(count + 1) > rows.count(count)
    for key, array in keys.items():
        valid = count + (longer and key.startswith("obs/"))
        if len(array) != valid:
            hint = f" or {count + 1}" if key.startswith("obs/") and not longer else ""
            message = f"shape {array.shape}; valid: {valid}{hint} rows, as the other arrays have"
            raise DataError(path, f"{demo}/{key}", message)


def _rows_of_dones(path: str | Path, file: h5py.File, demo: str) -> list[int]:
    node = read_node(path, file, f"{demo}/dones")
    return [len(node)] if isinstance(node, h5py.Dataset) and node.ndim else []


def _has_rows(path: str | Path, file: h5py.File, key: str, steps: int) -> bool:
    """Whether a node is an array of numbers with a row for each step."""
    node = read_node(path, file, key)
    if node is None:
        raise DataError(path, key, "unreadable: a link to a missing node")
    try:
        if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "biuf":
            return False
        return node.shape[:1] == (steps,)
    except DAMAGE as error:
        raise DataError(path, key, f"unreadable ({error})") from error


def _read_flags(path: str | Path, file: h5py.File, key: str) -> np.ndarray:
    return as_flags(path, key, _read_column(path, file, key))


def _read_column(path: str | Path, file: h5py.File, key: str) -> np.ndarray:
    """An array of one number for each step, which some tools store as ``(T, 1)``."""
    array = read_array(path, file, key)
    if not array.ndim:
        raise DataError(path, key, "one number; valid: a row for each step")
    return array[:, 0] if array.shape[1:] == (1,) else array
