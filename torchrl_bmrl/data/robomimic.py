"""Demonstrations in robomimic's HDF5 layout.

Layout of a file::

    data                      attributes: total, env_args (JSON), and what the collector adds
    data/demo_<i>             attributes: num_samples, model_file, seed, ...
        obs/<name>, next_obs/<name>    (T, ...)
        actions               (T, action_dim) in [-1, 1]
        rewards, dones        (T,)  dones: 1 at the last step
        terminated            (T,)  this library's: where no value follows; absent: nowhere
        successes             (T,)  this library's: the task's own definition
        states                (T, n) the simulator's state before each action
    mask/train, mask/valid    names of demonstrations, bytes

Whatever else has T rows is kept as it is.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.hdf5 import DAMAGE, write_attributes
from torchrl_bmrl.data.options import Bounds, check_bounds
from torchrl_bmrl.data.robomimic_file import (
    MASKS,
    count_episodes,
    count_steps,
    find_mask_problems,
    find_oddities,
    read_metadata,
)
from torchrl_bmrl.data.robomimic_reader import STEP_KEYS, open_episodes, open_raw
from torchrl_bmrl.data.schema import check_episode, layout_of
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import atomic_path, write_atomic

with needs("data"):
    import h5py

__all__ = [
    "MASKS",
    "count_episodes",
    "count_steps",
    "find_mask_problems",
    "find_oddities",
    "keep_episode",
    "open_episodes",
    "open_raw",
    "read_kept_episode",
    "read_metadata",
    "write_episodes",
]


def write_episodes(
    path: str | Path,
    episodes: Iterable[Episode],
    *,
    env_args: Mapping[str, Any],
    attributes: Mapping[str, str | int | float] | None = None,
    masks: Mapping[str, Iterable[int]] | None = None,
    bounds: Bounds = (-1.0, 1.0),
) -> None:
    """Writes a whole file, or leaves none.

    Every array carries checksums, and so do names and shapes: damage is found when it is read.

    Args:
        path: the HDF5 file, which replaces one that is there.
        episodes: in order, named ``demo_0``, ``demo_1``, ...
        env_args: robomimic's environment metadata: ``env_name``, ``type``, ``env_version`` and
            ``env_kwargs``.
        attributes: further attributes of ``data``.
        masks: positions of the episodes of each mask, such as ``{"train": range(60)}``.
        bounds: of floating-point actions; other ones than [-1, 1] are kept in the attribute
            ``action_bounds`` of ``data``, and readers of this library take them from there.

    Raises:
        DataError: for an episode that could not be trained on, without episodes, and if an extra is
            named like one of the layout's own arrays.
        ConfigError: if a mask has a position that no episode has.

    Example:
        >>> import tempfile
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "lift.hdf5"
        >>> env_args = {"env_name": "Lift", "type": 1, "env_version": "1.5", "env_kwargs": {}}
        >>> write_episodes(path, [episode] * 2, env_args=env_args, masks={"train": range(2)})
        >>> read_metadata(path)["masks"]
        {'train': ['demo_0', 'demo_1']}
    """
    bounds = check_bounds(bounds)
    # HDF5's default structures have no checksums, these have; "latest" could only be read by the
    # very version that wrote it.
    version = ("v110", "v110")
    with atomic_path(path) as temporary, h5py.File(temporary, "w", libver=version) as file:
        data = file.create_group("data")
        names: list[str] = []
        total = 0
        layout = None
        for i, episode in enumerate(episodes):
            names.append(f"demo_{i}")
            _check_names(path, f"data/{names[-1]}", episode)
            check_episode(path, f"data/{names[-1]}", episode, layout=layout, bounds=bounds)
            layout = layout or layout_of(episode)
            _write_episode(data.create_group(names[-1]), episode)
            total += len(episode)
        if not names:
            raise DataError(path, None, "no episodes; valid: at least one")
        texts = {"env_args": json.dumps(dict(env_args))}
        if bounds != (-1.0, 1.0):
            texts["action_bounds"] = json.dumps({"low": bounds[0], "high": bounds[1]})
        write_attributes(data, {"total": total, **texts, **(attributes or {})})
        for name, positions in (masks or {}).items():
            # Not as file["mask/..."]: a group made on the way carries the time of day.
            positions = list(positions)
            if wrong := [i for i in positions if not 0 <= i < len(names)]:
                raise ConfigError(f"mask {name!r} has {wrong[0]}; valid: 0 to {len(names) - 1}")
            mask = np.array([names[i] for i in positions], dtype="S")
            _write_array(file.require_group("mask"), name, mask)


def _check_names(path: str | Path, demo: str, episode: Episode) -> None:
    for key in episode.extras:
        if key in STEP_KEYS:
            message = f"an extra; valid: other names than {', '.join(STEP_KEYS)}"
            raise DataError(path, f"{demo}/{key}", message)
    for key in [*episode.extras, *episode.observations]:
        if "/" in key:
            raise DataError(path, f"{demo}/{key}", "valid: names without '/'")


def _write_episode(demo: h5py.Group, episode: Episode) -> None:
    dones = np.zeros(len(episode), dtype=np.int64)
    dones[-1:] = 1
    arrays = {
        **{f"obs/{name}": part for name, part in episode.observations.items()},
        **{f"next_obs/{name}": part for name, part in episode.next_observations.items()},
        "actions": episode.actions,
        "rewards": episode.rewards,
        "dones": dones,
        "terminated": episode.terminated,
        **episode.extras,
    }
    for key, array in arrays.items():
        _write_array(demo, key, array)
    write_attributes(demo, {"num_samples": len(episode), **episode.attributes})


def _write_array(group: h5py.Group, key: str, array: np.ndarray) -> None:
    # The checksum of zeros is zero: a hole in a file would pass for data, but not for compressed
    # ones. What has no elements cannot be cut into chunks, which checksums and filters belong to.
    filters = {"compression": "gzip", "compression_opts": 1, "fletcher32": True}
    group.create_dataset(key, data=array, **(filters if array.size else {}))


def keep_episode(path: Path, episode: Episode) -> None:
    """Keeps one episode as an npz file, atomically, until its file is complete."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        **{f"obs/{name}": part for name, part in episode.observations.items()},
        **{f"next_obs/{name}": part for name, part in episode.next_observations.items()},
        **{f"extras/{name}": array for name, array in episode.extras.items()},
        actions=episode.actions,
        rewards=episode.rewards,
        terminated=episode.terminated,
        attributes=np.frombuffer(json.dumps(dict(episode.attributes)).encode(), dtype=np.uint8),
    )
    write_atomic(path, buffer.getvalue())


def read_kept_episode(path: Path) -> Episode:
    """Reads what :func:`keep_episode` wrote.

    Raises:
        DataError: if the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file}
        attributes = json.loads(arrays.pop("attributes").tobytes())

        def group(prefix: str) -> dict[str, np.ndarray]:
            return {
                key.removeprefix(prefix): array
                for key, array in arrays.items()
                if key.startswith(prefix)
            }

        return Episode(
            observations=group("obs/"),
            next_observations=group("next_obs/"),
            actions=arrays["actions"],
            rewards=arrays["rewards"],
            terminated=arrays["terminated"],
            extras=group("extras/"),
            attributes=attributes,
        )
    except (*DAMAGE, EOFError, zipfile.BadZipFile) as error:
        raise DataError(path, None, f"not a whole episode ({error}); remove it") from error
