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
therefore stored unchanged and declared as boxes of int32, which no reader mistakes for JPEG.

Minari 0.5.3 (but neither 0.5.2 nor 0.5.4) compresses every uint8 array of two or three dimensions,
including small images and plain vectors, and returns the bytes of the JPEG if the space is not an
image. The reader recognises them by their first bytes and decodes those of the space's shape.
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
from torchrl_bmrl.data.hdf5 import DAMAGE, VERSION, write_array, write_attributes
from torchrl_bmrl.data.minari_reader import OWN_ATTRIBUTES, open_data
from torchrl_bmrl.data.options import Bounds, check_bounds
from torchrl_bmrl.data.schema import check_episode, check_fps, layout_of
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import new_folder

with needs("data"):
    import h5py

_UNBOUNDED = (-np.inf, np.inf)

__all__ = ["open_data", "write_episodes"]


def write_episodes(
    path: str | os.PathLike[str],
    episodes: Iterable[Episode],
    *,
    fps: float | None = None,
    description: str = "",
    bounds: Bounds | None = None,
) -> None:
    """Writes a whole data set, or nothing.

    ``minari.load_dataset("<namespace>/<name>-v<number>")`` reads it if ``MINARI_DATASETS_PATH`` is
    the folder of the namespace. TorchRL's ``MinariExperienceReplay`` reads it with
    ``load_from_local_minari=True``, but its version 0.14.1 shows every Minari data set as zeros
    (it stores the data with ``memmap_like``, which only copies shapes) and fails on a single
    episode.

    Every array keeps its dtype. Arrays, names and shapes have checksums.

    Args:
        path: the new folder ``<namespace>/<name>-v<number>``; both names form the data set's id.
        episodes: of equal parts, shapes and dtypes, consumed one at a time.
        fps: steps per second [Hz], stored in ``metadata.json``.
        description: stored in ``metadata.json``.
        bounds: of floating-point actions, stored as their space; ``None`` for an unbounded space.

    Raises:
        DataError: if the folder exists or its name is not a valid Minari id, without episodes, and,
            naming episode, key and row, for an episode that cannot be stored.
        ConfigError: if ``fps`` is not positive, and for invalid bounds.
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
        with h5py.File(folder / "data" / "main_data.hdf5", "w", libver=VERSION) as file:
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
            "not a Minari id; valid: <namespace>/<name>-v<number> of letters, digits, '-' and "
            "'_', at least two of them in the namespace, such as sawyer/lift-v0",
        )
    return f"{whole.parent.name}/{whole.name}"


def _arrays(path: Path, name: str, episode: Episode) -> dict[str, np.ndarray]:
    """The arrays that the file stores of an episode, by their keys below the episode."""
    whole = join_observations(path, name, episode)
    last = np.arange(len(episode)) == len(episode) - 1
    terminated = episode.terminated.astype(bool)
    infos = {key: np.concatenate([array, array[-1:]]) for key, array in episode.extras.items()}
    if "success" in infos:
        message = "the name that Minari uses for the extra 'successes'; valid: another name"
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
            message = (
                f"{array.dtype} {array.shape}; valid: bool, float, int64 and smaller, not empty"
            )
            raise DataError(path, f"{name}/{key}", message)
    return arrays


def _spaces(arrays: Mapping[str, np.ndarray], bounds: Bounds | None) -> dict[str, Any]:
    with needs("data"):
        from gymnasium.spaces import Dict

    prefix = "observations/"
    # Pairs, because gymnasium would sort a mapping, and the parts keep their order.
    parts = [(key[len(prefix) :], _box(x)) for key, x in arrays.items() if key.startswith(prefix)]
    return {"observation_space": Dict(parts), "action_space": _box(arrays["actions"], bounds)}


def _box(array: np.ndarray, bounds: Bounds | None = None) -> Any:
    """A box of all numbers of the dtype or, for floating-point numbers, of those in the bounds."""
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
        # Resizable, as Minari's own arrays are.
        write_array(where, leaf, array, chunks=True, maxshape=(None, *array.shape[1:]))
    for key, value in episode.attributes.items():
        message = f"{type(value).__name__}; valid: numbers, strings and lists of strings"
        try:
            if key in OWN_ATTRIBUTES:
                raise ValueError("a name that Minari itself uses")
            write_attributes(group, {key: value})
        except DAMAGE as error:
            raise DataError(path, f"{name}, attribute {key!r}", f"{message} ({error})") from error
    group.attrs.update({"id": number, "total_steps": len(episode)})
