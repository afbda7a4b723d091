"""Demonstrations in robomimic's HDF5 layout.

Layout of a file::

    data                      attributes: total, env_args (JSON), and what the collector adds
    data/demo_<i>             attributes: num_samples, model_file, seed, ...
        obs/<name>, next_obs/<name>    (T, ...)
        actions               (T, action_dim) in [-1, 1]
        rewards, dones        (T,)  dones: 1 at the last step
        terminated            (T,)  of this library: where no value follows; absent: nowhere
        successes             (T,)  of this library: the task's own definition of success
        states                (T, n) the simulator's state before each action
    mask/train, mask/valid    names of demonstrations, bytes

Other arrays of T rows are read and written unchanged.
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
from torchrl_bmrl.data.hdf5 import DAMAGE, VERSION, write_array, write_attributes
from torchrl_bmrl.data.options import Bounds, check_bounds
from torchrl_bmrl.data.robomimic_file import MASKS, count_episodes, count_steps, read_metadata
from torchrl_bmrl.data.robomimic_reader import STEP_KEYS, open_data, open_episodes
from torchrl_bmrl.data.schema import check_episode, layout_of
from torchrl_bmrl.envs.assets import shorten_paths
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import atomic_path, parse_json, write_atomic

with needs("data"):
    import h5py

__all__ = [
    "MASKS",
    "count_episodes",
    "count_steps",
    "keep_episode",
    "open_data",
    "open_episodes",
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
    """Writes a whole file, or nothing.

    Arrays, names and shapes have checksums, so that damage is detected when the file is read.

    Args:
        path: the HDF5 file; an existing one is replaced.
        episodes: in order, named ``demo_0``, ``demo_1``, ...
        env_args: robomimic's environment metadata: ``env_name``, ``type``, ``env_version`` and
            ``env_kwargs``.
        attributes: further attributes of ``data``.
        masks: positions of the episodes of each mask, such as ``{"train": range(60)}``.
        bounds: of floating-point actions. Bounds other than [-1, 1] are stored in the attribute
            ``action_bounds`` of ``data``, which this library's readers use.

    Raises:
        DataError: for an episode that cannot be trained on, without episodes, and for an extra with
            the name of one of the layout's own arrays.
        ConfigError: for a position in a mask that is not an episode's.

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
    with atomic_path(path) as temporary, h5py.File(temporary, "w", libver=VERSION) as file:
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
            # Not as file["mask/..."]: an implicitly created group stores the time of day.
            positions = list(positions)
            if wrong := [i for i in positions if not 0 <= i < len(names)]:
                raise ConfigError(f"mask {name!r} has {wrong[0]}; valid: 0 to {len(names) - 1}")
            mask = np.array([names[i] for i in positions], dtype="S")
            write_array(file.require_group("mask"), name, mask)


def _check_names(path: str | Path, demo: str, episode: Episode) -> None:
    for key in episode.extras:
        if key in STEP_KEYS:
            message = f"an extra; valid: other names than {', '.join(STEP_KEYS)}"
            raise DataError(path, f"{demo}/{key}", message)
    for key in [*episode.extras, *episode.observations]:
        if "/" in key:
            raise DataError(path, f"{demo}/{key}", "valid: names without '/'")


def _observations(episode: Episode) -> dict[str, np.ndarray]:
    return {
        **{f"obs/{name}": part for name, part in episode.observations.items()},
        **{f"next_obs/{name}": part for name, part in episode.next_observations.items()},
    }


def _write_episode(demo: h5py.Group, episode: Episode) -> None:
    dones = np.zeros(len(episode), dtype=np.int64)
    dones[-1:] = 1
    arrays = {
        **_observations(episode),
        "actions": episode.actions,
        "rewards": episode.rewards,
        "dones": dones,
        "terminated": episode.terminated,
        **episode.extras,
    }
    for key, array in arrays.items():
        write_array(demo, key, array)
    attributes = dict(episode.attributes)
    if isinstance(model := attributes.get("model_file"), str):
        attributes["model_file"] = shorten_paths(model)
    write_attributes(demo, {"num_samples": len(episode), **attributes})


def keep_episode(path: Path, episode: Episode) -> None:
    """Writes one episode to a temporary npz file, atomically, until all episodes are collected."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        **_observations(episode),
        **{f"extras/{name}": array for name, array in episode.extras.items()},
        actions=episode.actions,
        rewards=episode.rewards,
        terminated=episode.terminated,
        attributes=np.frombuffer(json.dumps(dict(episode.attributes)).encode(), dtype=np.uint8),
    )
    write_atomic(path, buffer.getvalue())


def read_kept_episode(path: Path) -> Episode:
    """Reads an episode that :func:`keep_episode` wrote.

    Raises:
        DataError: if the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file}
        attributes = parse_json(arrays.pop("attributes").tobytes())

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
        raise DataError(path, None, f"not a complete episode ({error}); remove it") from error
