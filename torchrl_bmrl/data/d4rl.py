"""Reads D4RL's flat HDF5 layout: each array holds the steps of all episodes.

Layout of a file of N steps::

    observations         (N, ...), or a group of named parts
    actions              (N, action_dim), or (N,)
    rewards              (N,)
    terminals            (N,) 0 or 1: no value follows
    timeouts             (N,) 0 or 1: the episode was cut; optional
    next_observations    as observations; optional
    infos/<name>         (N, ...)
    metadata/<name>      texts and numbers about the data set

Rows of one number may also be ``(N, 1)``. Other arrays of N rows of numbers are read as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.arrays import as_column, as_flags, check_finite
from torchrl_bmrl.data.d4rl_layout import AFTER, ARRAYS, BEFORE, Flat, find_jumps, walk
from torchrl_bmrl.data.episodes import LazyEpisodes
from torchrl_bmrl.data.hdf5 import (
    open_file,
    read_array,
    read_attributes,
    read_names,
    read_node,
    read_strings,
)
from torchrl_bmrl.data.raw import Opened, RawEpisode
from torchrl_bmrl.extras import needs

with needs("data"):
    import h5py


def is_d4rl(path: str | Path, file: h5py.File) -> bool:
    """Whether the arrays of a file lie flat at its top."""
    present = set(read_names(path, file, "/"))
    return "data" not in present and len(present & {BEFORE, *ARRAYS}) > 1


@contextmanager
def open_data(path: str | Path, *, horizon: int | None = None) -> Iterator[Opened]:
    """Opens a file; each episode is read on access.

    An episode ends at a terminal and at a timeout. In files without ``timeouts`` it ends at a
    terminal and after ``horizon`` steps, as D4RL's own tools cut; without a horizon, at a terminal
    and where the next observation is not the next row's. Files with none of the three are refused,
    because nothing separates their episodes. The rows after the last end are one more episode,
    which was cut.

    ``infos/<name>`` becomes the extra ``<name>``, and ``infos/<a>/<b>`` the extra ``<a>_<b>``.
    ``success``, whose row t follows step t, becomes ``successes``. ``left_alone`` lists what is not
    read.

    Args:
        path: the HDF5 file; it is only read.
        horizon: steps of the longest episode, for files without ``timeouts``. If it is at least N,
            terminals alone end episodes.

    Yields:
        the episodes, named by their rows (``rows_0_to_199``, ...); the file's attributes together
        with attributes, texts and numbers below ``metadata``; and oddities.
        ``next_observations`` is ``None`` if the file has none.

    Raises:
        DataError: naming file, key and row, for a missing or damaged file, arrays that are missing
            or of different lengths, unknown ends of episodes, flags other than 0 and 1, and numbers
            that are not finite. The last is raised when the episode is read.
        ConfigError: for a horizon below 1, or with a file that has ``timeouts``.
    """
    with open_file(path) as file:
        flat = Flat.of(path, file, horizon)
        metadata = read_attributes(path, file, "/")
        beside: list[str] = []
        if isinstance(read_node(path, file, "metadata"), h5py.Group):
            told, beside = _read_group(path, file, "metadata")
            metadata |= told
        oddities = list(_end_oddities(path, file, flat, horizon))
        if beside:
            oddities.append(
                f"{len(beside)} arrays below metadata are not read, such as {beside[0]}"
            )
        names = {f"rows_{rows.start}_to_{rows.stop - 1}": rows for rows in flat.episodes()}
        # HDF5 drops the decompressed chunks of an array when its last handle is closed, and the
        # next episode lies in the same chunk.
        keys = ["actions", "rewards", *flat.parts.values(), *flat.after.values()]
        handles = [read_node(path, file, key) for key in [*keys, *flat.extras.values()]]

        def read(name: str) -> RawEpisode:
            return _read_episode(path, file, flat, names[name])

        yield Opened(episodes=LazyEpisodes(names, read), metadata=metadata, oddities=oddities)
        del handles


def _end_oddities(
    path: str | Path, file: h5py.File, flat: Flat, horizon: int | None
) -> Iterator[str]:
    if flat.timeouts is None and horizon is None:
        yield (
            "no timeouts: an episode ends at a terminal and where the next observation is not the "
            "next row's"
        )
        if not flat.ends[:-1].any() and flat.steps > 1:
            yield (
                f"all {flat.steps} rows are one episode: if {AFTER} were made by shifting, ends "
                "are hidden"
            )
    if not flat.ended:
        first = flat.episodes()[-1].start
        yield (
            f"rows {first} to {flat.steps - 1} end in neither a terminal nor a timeout: read as an "
            "episode that was cut"
        )
    if flat.timeouts is None:
        return
    if len(both := np.flatnonzero(flat.timeouts & flat.terminals)):
        yield (
            f"{len(both)} rows are terminal and timeout at once, such as {both[0]}: read as "
            "terminal"
        )
    if flat.after:
        cut = flat.timeouts & ~flat.terminals
        wrong = np.flatnonzero(cut & ~find_jumps(path, file, flat))
        if len(wrong):
            yield (
                f"at {len(wrong)} of {int(cut.sum())} timeouts, such as row {wrong[0]}, "
                f"{AFTER} is the next episode's first observation: values bootstrapped from there "
                f"are wrong, unless the episode went on; without {AFTER} these steps are left out"
            )


def _read_episode(path: str | Path, file: h5py.File, flat: Flat, rows: slice) -> RawEpisode:
    def read(key: str) -> np.ndarray:
        array = read_array(path, file, key, rows)
        check_finite(path, key, array, rows.start)
        return array

    actions = read("actions")
    if actions.ndim == 1 and actions.dtype.kind == "f":  # integers are indices of discrete actions
        actions = actions[:, None]
    extras = {name: read(key) for name, key in flat.extras.items()}
    if "successes" in extras:
        key = flat.extras["successes"]
        flags = as_column(path, key, extras["successes"])
        extras["successes"] = as_flags(path, key, flags, rows.start)
    return RawEpisode(
        observations={part: read(key) for part, key in flat.parts.items()},
        next_observations={part: read(key) for part, key in flat.after.items()} or None,
        actions=actions,
        rewards=as_column(path, "rewards", read("rewards")) if flat.rewards else None,
        terminated=flat.terminals[rows],
        extras=extras,
        left_alone=flat.left_alone,
    )


def _read_group(path: str | Path, file: h5py.File, key: str) -> tuple[dict[str, Any], list[str]]:
    """Attributes, texts and numbers in a group and its subgroups, and keys of larger arrays."""
    told, beside = read_attributes(path, file, key), []
    for where in walk(path, file, key):
        node = read_node(path, file, where)
        name = where.removeprefix(f"{key}/")
        kind = node.dtype.kind if isinstance(node, h5py.Dataset) and node.shape == () else ""
        if kind and kind in "OSU":
            told[name] = read_strings(path, file, where)[0]
        elif kind and kind in "biuf":
            told[name] = read_array(path, file, where).item()
        else:
            beside.append(where)
    return told, beside
