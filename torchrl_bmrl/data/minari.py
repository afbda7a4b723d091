"""Data sets in Minari's HDF5 layout: written whole, read one episode at a time.

Layout of the folder ``<namespace>/<name>-v<number>``::

    data/metadata.json         dataset_id, spaces, totals, description, fps
    data/main_data.hdf5
        episode_<i>            attributes: id, total_steps and those of the episode
            observations/<part>    (T + 1, ...) before each action and after the last
            actions                (T, action_dim)
            rewards                (T,)
            terminations           (T,) bool
            truncations            (T,) bool: the last step, unless it terminates
            infos/success          (T + 1,) row t + 1 after step t; row 0 is False
            infos/<extra>          (T + 1, ...) row t before step t; the last row is repeated

Minari compresses uint8 images to JPEG, which loses bits and which TorchRL cannot read. Images are
therefore kept as they are and declared as boxes of int32, which no reader takes for JPEG.

Version 0.5.3 of Minari (neither 0.5.2 nor 0.5.4) compresses every array of uint8 with two or three
dimensions, small images and plain vectors among them, and returns the bytes of the JPEG where the
space is no image. :func:`open_raw` finds them by their first bytes and decodes what has the space's
shape.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, join_observations
from torchrl_bmrl.data.hdf5 import DAMAGE, write_attributes
from torchrl_bmrl.data.minari_reader import (
    OWN_ATTRIBUTES,
    find_oddities,
    open_episodes,
    open_raw,
    read_metadata,
)
from torchrl_bmrl.data.options import Bounds, check_bounds
from torchrl_bmrl.data.schema import check_episode, check_fps, layout_of
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import new_folder

with needs("data"):
    import h5py

_UNBOUNDED = (-np.inf, np.inf)

__all__ = ["find_oddities", "open_episodes", "open_raw", "read_metadata", "write_episodes"]


def write_episodes(
    path: str | os.PathLike[str],
    episodes: Iterable[Episode],
    *,
    fps: float | None = None,
    description: str = "",
    bounds: Bounds | None = None,
) -> None:
    """Writes a whole data set, or none.

    ``minari.load_dataset("<namespace>/<name>-v<number>")`` reads it where ``MINARI_DATASETS_PATH``
    is the folder that holds the namespace. So does TorchRL's ``MinariExperienceReplay`` with
    ``load_from_local_minari=True``, but version 0.14.1 has two faults of its own: it shows any
    Minari data set as zeros (it stores what it read with ``memmap_like``, which keeps shapes
    alone), and it fails on a single episode. :func:`open_episodes` has neither.

    Every array keeps its dtype and carries checksums, and so do names and shapes.

    Args:
        path: the new folder ``<namespace>/<name>-v<number>``; both names make the data set's id.
        episodes: of equal parts, shapes and dtypes, consumed one at a time.
        fps: steps per second [Hz], kept in ``metadata.json``.
        description: kept in ``metadata.json``.
        bounds: of floating-point actions, which become their space; ``None`` for a space without.

    Raises:
        DataError: if the folder exists or its name is no id of Minari's, without episodes, and for
            an episode that cannot be kept: naming episode, key and row.
        ConfigError: if ``fps`` is not positive, and for bounds that are none.
        MissingExtraError: if minari is not installed.
    """
    path = Path(path)
    dataset_id = _dataset_id(path)
    if fps is not None:
        check_fps(fps)
    if bounds is not None:
        bounds = check_bounds(bounds)
    with needs("data"):
        from minari import __version__ as version
        from minari.dataset.minari_storage import MinariStorage
    with new_folder(path) as folder:
        remaining = iter(episodes)
        first = next(remaining, None)
        if first is None:
            raise DataError(path, None, "no episodes; valid: at least one")
        check_episode(path, "episode_0", first, bounds=bounds)
        layout = layout_of(first)
        # Not create_dataset_from_buffers: that writes to the user's own data sets, and JPEG.
        # An absolute path: Minari joins a relative one with itself.
        storage = MinariStorage.new(
            folder.absolute() / "data", **_spaces(_arrays(path, "episode_0", first), bounds)
        )
        lengths = []
        # HDF5's default structures have no checksums, these have; "latest" could only be read by
        # the very version that wrote it.
        libver = ("v110", "v110")
        with h5py.File(folder / "data" / "main_data.hdf5", "w", libver=libver) as file:
            for i, episode in enumerate(chain([first], remaining)):
                check_episode(path, f"episode_{i}", episode, layout=layout, bounds=bounds)
                for key in sorted(set(first.extras) ^ set(episode.extras)):
                    message = "missing; valid: the same extras in all episodes"
                    raise DataError(path, f"episode_{i}/{key}", message)
                _write_episode(path, file.create_group(f"episode_{i}"), i, episode)
                lengths.append(len(episode))
        metadata = {
            "dataset_id": dataset_id,
            "minari_version": version,
            "description": description,
            "total_episodes": len(lengths),
            "total_steps": sum(lengths),
            "dataset_size": float(storage.get_size()),
        }
        storage.update_metadata(metadata if fps is None else {**metadata, "fps": fps})


def _dataset_id(path: Path) -> str:
    whole = path.resolve()
    if not re.fullmatch(r"[-\w]{2,}/[-\w]+-v\d+", f"{whole.parent.name}/{whole.name}"):
        raise DataError(
            path,
            None,
            "no id of Minari's; valid: <namespace>/<name>-v<number> of letters, digits, '-' and "
            "'_', at least two of them in the namespace, such as sawyer/lift-v0",
        )
    return f"{whole.parent.name}/{whole.name}"


def _arrays(path: Path, name: str, episode: Episode) -> dict[str, np.ndarray]:
    """What the file keeps of an episode, by its key below the episode."""
    whole = join_observations(path, name, episode)
    last = np.arange(len(episode)) == len(episode) - 1
    terminated = episode.terminated.astype(bool)
    infos = {key: np.concatenate([array, array[-1:]]) for key, array in episode.extras.items()}
    if "success" in infos:
        message = "Minari's name for the extra 'successes'; valid: another name"
        raise DataError(path, f"{name}/success", message)
    if "successes" in infos:
        successes = episode.extras["successes"]
        infos["success"] = np.concatenate([np.zeros_like(successes[:1]), successes])
        del infos["successes"]
    arrays = {
        **{f"observations/{part}": array for part, array in whole.items()},
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminations": terminated,
        "truncations": last & ~terminated,
        **{f"infos/{key}": array for key, array in infos.items()},
    }
    for key, array in arrays.items():
        if key.count("/") > 1 or key.endswith(("/", "/.")):
            raise DataError(path, f"{name}/{key}", "valid: names without '/', neither '' nor '.'")
        if array.dtype.itemsize > 8 or array.dtype == np.uint64 or not array.size:
            message = f"{array.dtype} {array.shape}; valid: bool, float, int64 and smaller, no 0"
            raise DataError(path, f"{name}/{key}", message)
    return arrays


def _spaces(arrays: Mapping[str, np.ndarray], bounds: Bounds | None) -> dict[str, Any]:
    with needs("data"):
        from gymnasium.spaces import Dict

    prefix = "observations/"
    # Pairs, because gymnasium sorts a mapping, and the parts are to come back in their order.
    parts = [(key[len(prefix) :], _box(x)) for key, x in arrays.items() if key.startswith(prefix)]
    return {"observation_space": Dict(parts), "action_space": _box(arrays["actions"], bounds)}


def _box(array: np.ndarray, bounds: Bounds | None = None) -> Any:
    """Contains whatever the dtype can hold or, of floating-point numbers, what the bounds do."""
    with needs("data"):
        from gymnasium.spaces import Box

    dtype, shape = array.dtype, array.shape[1:]
    if dtype.kind == "f":
        ends = [np.broadcast_to(end, shape).astype(dtype) for end in bounds or _UNBOUNDED]
        return Box(ends[0], ends[1], shape, dtype.type)
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    # Neither uint8, which can mean JPEG, nor the dtypes that TorchRL's reader does not know.
    return Box(low, high, shape, np.int32 if np.can_cast(dtype, np.int32) else np.int64)


def _write_episode(path: Path, group: h5py.Group, number: int, episode: Episode) -> None:
    name = f"episode_{number}"
    for key, array in _arrays(path, name, episode).items():
        parent, _, leaf = key.rpartition("/")
        # Not by its whole key: a group made on the way carries the time of day.
        where = group.require_group(parent) if parent else group
        # Resizable, as Minari's own are. The checksum of zeros is zero: a hole in a file would pass
        # for data, but not for compressed ones.
        filters = {"compression": "gzip", "compression_opts": 1, "fletcher32": True}
        shape = (None, *array.shape[1:])
        where.create_dataset(leaf, data=array, chunks=True, maxshape=shape, **filters)
    for key, value in episode.attributes.items():
        message = f"{type(value).__name__}; valid: numbers, strings and lists of strings"
        try:
            if key in OWN_ATTRIBUTES:
                raise ValueError("a name of Minari's own")
            write_attributes(group, {key: value})
        except DAMAGE as error:
            raise DataError(path, f"{name}, attribute {key!r}", f"{message} ({error})") from error
    group.attrs.update({"id": number, "total_steps": len(episode)})
