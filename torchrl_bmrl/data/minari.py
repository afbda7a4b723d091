"""Data sets in Minari's HDF5 layout: written whole, checked, read one episode at a time.

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
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, LazyEpisodes, join_observations
from torchrl_bmrl.data.hdf5 import (
    DAMAGE,
    open_file,
    read_array,
    read_attributes,
    read_names,
    write_attributes,
)
from torchrl_bmrl.data.schema import check_episode, check_fps, layout_of
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import new_folder

with needs("data"):
    import h5py

_OWN_ATTRIBUTES = ("id", "total_steps")
_SPACES = ("Box", "Discrete", "MultiBinary", "MultiDiscrete")


# -- writing ---------------------------------------------------------------------------------------


def write_episodes(
    path: str | os.PathLike[str],
    episodes: Iterable[Episode],
    *,
    fps: float | None = None,
    description: str = "",
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

    Raises:
        DataError: if the folder exists or its name is no id of Minari's, without episodes, and for
            an episode that cannot be kept: naming episode, key and row.
        ConfigError: if ``fps`` is not positive.
        MissingExtraError: if minari is not installed.
    """
    path = Path(path)
    dataset_id = _dataset_id(path)
    if fps is not None:
        check_fps(fps)
    with needs("data"):
        from minari import __version__ as version
        from minari.dataset.minari_storage import MinariStorage
    with new_folder(path) as folder:
        remaining = iter(episodes)
        first = next(remaining, None)
        if first is None:
            raise DataError(path, None, "no episodes; valid: at least one")
        check_episode(path, "episode_0", first, bounds=None)
        layout = layout_of(first)
        # Not create_dataset_from_buffers: that writes to the user's own data sets, and JPEG.
        # An absolute path: Minari joins a relative one with itself.
        storage = MinariStorage.new(
            folder.absolute() / "data", **_spaces(_arrays(path, "episode_0", first))
        )
        lengths = []
        # Newer structures of HDF5 than its default: theirs have checksums.
        with h5py.File(folder / "data" / "main_data.hdf5", "w", libver="latest") as file:
            for i, episode in enumerate(chain([first], remaining)):
                check_episode(path, f"episode_{i}", episode, layout=layout, bounds=None)
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


def _spaces(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    with needs("data"):
        from gymnasium.spaces import Dict

    prefix = "observations/"
    # Pairs, because gymnasium sorts a mapping, and the parts are to come back in their order.
    parts = [(key[len(prefix) :], _box(x)) for key, x in arrays.items() if key.startswith(prefix)]
    return {"observation_space": Dict(parts), "action_space": _box(arrays["actions"])}


def _box(array: np.ndarray) -> Any:
    """Contains whatever the dtype can hold."""
    with needs("data"):
        from gymnasium.spaces import Box

    dtype, shape = array.dtype, array.shape[1:]
    if dtype.kind == "f":
        return Box(-np.inf, np.inf, shape, dtype.type)
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    # Neither uint8, which can mean JPEG, nor the dtypes that TorchRL's reader does not know.
    return Box(low, high, shape, np.int32 if np.can_cast(dtype, np.int32) else np.int64)


def _write_episode(path: Path, group: h5py.Group, number: int, episode: Episode) -> None:
    name = f"episode_{number}"
    for key, array in _arrays(path, name, episode).items():
        parent, _, leaf = key.rpartition("/")
        # Not by its whole key: a group made on the way carries the time of day.
        where = group.require_group(parent) if parent else group
        # Resizable, as Minari's own are.
        shape = (None, *array.shape[1:])
        where.create_dataset(leaf, data=array, chunks=True, maxshape=shape, fletcher32=True)
    for key, value in episode.attributes.items():
        message = f"{type(value).__name__}; valid: numbers, strings and lists of strings"
        try:
            if key in _OWN_ATTRIBUTES:
                raise ValueError("a name of Minari's own")
            write_attributes(group, {key: value})
        except DAMAGE as error:
            raise DataError(path, f"{name}, attribute {key!r}", f"{message} ({error})") from error
    group.attrs.update({"id": number, "total_steps": len(episode)})


# -- reading ---------------------------------------------------------------------------------------


@contextmanager
def open_episodes(path: str | os.PathLike[str]) -> Iterator[Mapping[str, Episode]]:
    """Opens a data set, written here or by Minari; an episode is read when it is asked for.

    Observations without names are read as the part ``observation``. Where neither flag is set at
    the end, the episode was cut, which is a truncation. The info ``success`` becomes the extra
    ``successes``; every other array of numbers among the infos keeps its name and, of T + 1 rows,
    loses the last. Nested infos and strings are left out.

    Args:
        path: the data set's folder, which holds ``data/main_data.hdf5`` and ``data/metadata.json``.

    Yields:
        the episodes as ``episode_0``, ``episode_1``, ...; to be read inside the block.

    Raises:
        DataError: naming file and key, for a file that is missing, damaged or a git-LFS pointer, a
            missing key, a wrong number of rows, a space of tuples or text, or an end inside an
            episode. What concerns one episode is raised when that is read.
    """
    folder = Path(path) / "data"
    is_jpeg, count = _read_metadata(folder / "metadata.json")
    hdf5 = folder / "main_data.hdf5"
    with open_file(hdf5) as file:
        names = [f"episode_{i}" for i in range(count)]
        if read_names(hdf5, file, "/") != names:
            message = f"valid: episode_0 to {names[-1]}, as metadata.json announces"
            raise DataError(hdf5, None, message)

        def read(name: str) -> Episode:
            return _read_episode(hdf5, file, name, is_jpeg)

        yield LazyEpisodes(names, read)


def read_metadata(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What ``metadata.json`` says of a data set that :func:`open_episodes` opens."""
    return json.loads((Path(path) / "data" / "metadata.json").read_bytes())


def _read_metadata(path: Path) -> tuple[dict[str, bool], int]:
    """Keys of the observed parts below an episode, whether each is JPEG, and how many episodes."""
    try:
        content = path.read_bytes()
        if content.startswith(b"version https://git-lfs"):
            raise DataError(
                path, None, "a git-LFS pointer, not the data; `git lfs pull` fetches them"
            )
        metadata = json.loads(content)
        count, data_format = metadata["total_episodes"], metadata.get("data_format", "hdf5")
        spaces = {"observations": json.loads(metadata["observation_space"])}
        if spaces["observations"]["type"] == "Dict":
            parts = spaces.pop("observations")["subspaces"]
            spaces = {f"observations/{part}": space for part, space in parts.items()}
        is_jpeg = {key: _is_jpeg(space) for key, space in spaces.items()}
        spaces["actions"] = json.loads(metadata["action_space"])
        types = {key: space["type"] for key, space in spaces.items()}
    except DataError:
        raise
    except KeyError as error:
        raise DataError(path, str(error.args[0]), "missing") from error
    except OSError as error:
        raise DataError(path, None, f"unreadable ({error.strerror})") from error
    except (TypeError, ValueError, AttributeError, RecursionError) as error:
        raise DataError(path, None, f"not Minari's metadata ({error})") from error
    if data_format != "hdf5":
        raise DataError(path, "data_format", f"{data_format!r}; valid: 'hdf5'")
    if type(count) is not int or count < 1:
        raise DataError(path, "total_episodes", f"{count!r}; valid: 1 and more")
    for key, kind in types.items():
        if kind not in _SPACES:
            raise DataError(path, key, f"a space of type {kind}; valid: {', '.join(_SPACES)}")
    return is_jpeg, count


def _is_jpeg(space: Mapping[str, Any]) -> bool:
    """Minari's own rule for what it compresses."""
    shape = space.get("shape", ())
    if space.get("dtype") != "uint8" or len(shape) not in (2, 3) or min(shape[:2]) < 32:
        return False
    return bool(np.all(np.equal(space["low"], 0)) and np.all(np.equal(space["high"], 255)))


def _read_episode(path: Path, file: h5py.File, name: str, is_jpeg: Mapping[str, bool]) -> Episode:
    actions = read_array(path, file, f"{name}/actions")
    if not actions.ndim or not len(actions):
        raise DataError(path, f"{name}/actions", f"shape {actions.shape}; valid: at least one row")
    steps = len(actions)
    whole = {}
    for key, jpeg in is_jpeg.items():
        read = _read_jpeg if jpeg else read_array
        part = key.partition("/")[2] or "observation"
        key = f"{name}/{key}"
        whole[part] = _check_rows(path, key, read(path, file, key), steps + 1)
    ends = {}
    for flag in ("terminations", "truncations"):
        key = f"{name}/{flag}"
        ends[flag] = _check_rows(path, key, read_array(path, file, key), steps).astype(bool)
        for row in np.flatnonzero(ends[flag][:-1]):
            raise DataError(path, key, f"set in row {row} of {steps}; valid: in the last only")
    key = f"{name}/rewards"
    attributes = read_attributes(path, file, name)
    return Episode(
        observations={part: array[:-1] for part, array in whole.items()},
        next_observations={part: array[1:] for part, array in whole.items()},
        actions=actions,
        rewards=_check_rows(path, key, read_array(path, file, key), steps),
        terminated=ends["terminations"],
        extras=_read_extras(path, file, name, steps),
        attributes={key: x for key, x in attributes.items() if key not in _OWN_ATTRIBUTES},
    )


def _read_extras(path: Path, file: h5py.File, name: str, steps: int) -> dict[str, np.ndarray]:
    infos = f"{name}/infos"
    extras = {}
    for info in read_names(path, file, infos) if "infos" in read_names(path, file, name) else ():
        key = f"{infos}/{info}"
        if not _is_numbers(path, file, key):
            continue
        array = _check_rows(path, key, read_array(path, file, key), steps, steps + 1)
        extras["successes" if info == "success" else info] = (
            array[-steps:] if info == "success" else array[:steps]
        )
    return extras


def _is_numbers(path: Path, file: h5py.File, key: str) -> bool:
    try:
        node = file[key]
        return isinstance(node, h5py.Dataset) and node.dtype.kind in "biuf"
    except DAMAGE as error:
        raise DataError(path, key, f"unreadable ({error})") from error


def _check_rows(path: Path, key: str, array: np.ndarray, *counts: int) -> np.ndarray:
    if array.ndim == 0 or len(array) not in counts:
        valid = " or ".join(map(str, counts))
        raise DataError(path, key, f"shape {array.shape}; valid: {valid} rows")
    return array


def _read_jpeg(path: Path, file: h5py.File, key: str) -> np.ndarray:
    with needs("data"):
        from PIL import Image

    try:
        images = [Image.open(io.BytesIO(row.tobytes())) for row in file[key][()]]
        return np.stack([np.asarray(image) for image in images])
    except (*DAMAGE, SyntaxError) as error:
        raise DataError(path, key, f"missing or no JPEG ({error})") from error
