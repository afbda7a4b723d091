"""Demonstrations in robomimic's HDF5 layout: written, checked, read.

Layout of a file::

    data                      attributes: total, env_args (JSON), and what the collector adds
    data/demo_<i>             attributes: num_samples, seed
        obs/<name>, next_obs/<name>    (T, ...)
        actions               (T, action_dim) in [-1, 1]
        rewards, dones        (T,)  dones: 1 at the last step, where the horizon truncates
        successes             (T,)  the task's own definition
        phases                (T,)  the expert's phase; attribute names
        states                (T, n) the simulator's state before each action
    mask/train, mask/valid    names of demonstrations, bytes
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_bmrl.data.schema import OBSERVATION_SHAPES, check_episode
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.files import atomic_path, write_atomic


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode of T steps.

    Attributes:
        observations: named parts, each ``(T + 1, ...)``: before each action and after the last.
        actions: ``(T, action_dim)`` float32 in [-1, 1].
        rewards: ``(T,)``.
        successes: ``(T,)`` bool.
        phases: ``(T,)`` int8, index into ``phase_names``.
        states: simulator states, ``(T + 1, n)``.
        seed: that reproduces the start.
        phase_names: the expert's phases.
    """

    observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    successes: np.ndarray
    phases: np.ndarray
    states: np.ndarray
    seed: int
    phase_names: tuple[str, ...]


def write_episode(path: Path, episode: Episode) -> None:
    """Keeps one episode as an npz file, atomically."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        actions=episode.actions,
        rewards=episode.rewards,
        successes=episode.successes,
        phases=episode.phases,
        states=episode.states,
        seed=np.array(episode.seed),
        phase_names=np.array(episode.phase_names),
        **{f"obs/{name}": part for name, part in episode.observations.items()},
    )
    write_atomic(path, buffer.getvalue())


def read_episode(path: Path) -> Episode:
    """Reads what :func:`write_episode` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return Episode(
            observations={
                key.removeprefix("obs/"): file[key] for key in file if key.startswith("obs/")
            },
            actions=file["actions"],
            rewards=file["rewards"],
            successes=file["successes"],
            phases=file["phases"],
            states=file["states"],
            seed=int(file["seed"]),
            phase_names=tuple(str(name) for name in file["phase_names"]),
        )


def write_demonstrations(
    path: Path,
    episodes: Iterable[Episode],
    *,
    train_episodes: int,
    env_args: Mapping[str, Any],
    attributes: Mapping[str, str | int | float],
) -> None:
    """Writes a whole file, or leaves none.

    Args:
        path: the HDF5 file.
        episodes: in order; the first ``train_episodes`` are ``mask/train``, the rest
            ``mask/valid``.
        train_episodes: how many train.
        env_args: robomimic's environment metadata.
        attributes: further attributes of ``data``.
    """
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        data = file.create_group("data")
        names: list[str] = []
        total = 0
        for i, episode in enumerate(episodes):
            names.append(f"demo_{i}")
            demo = data.create_group(names[-1])
            steps = len(episode.actions)
            total += steps
            for name, part in episode.observations.items():
                demo[f"obs/{name}"] = part[:-1]
                demo[f"next_obs/{name}"] = part[1:]
            demo["actions"] = episode.actions
            demo["rewards"] = episode.rewards
            dones = np.zeros(steps, dtype=np.int64)
            dones[-1] = 1
            demo["dones"] = dones
            demo["successes"] = episode.successes
            demo["phases"] = episode.phases
            demo["phases"].attrs["names"] = list(episode.phase_names)
            demo["states"] = episode.states[:-1]
            demo.attrs["num_samples"] = steps
            demo.attrs["seed"] = episode.seed
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps(dict(env_args))
        for name, value in attributes.items():
            data.attrs[name] = value
        file["mask/train"] = np.array(names[:train_episodes], dtype="S")
        file["mask/valid"] = np.array(names[train_episodes:], dtype="S")


_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, MemoryError)
"""What h5py raises on a damaged file, depending on where the damage is."""


def _open(path: Path) -> h5py.File:
    if not Path(path).is_file():
        raise DataError(path, None, "no such file; recipes/collect.py writes it")
    try:
        return h5py.File(path, "r")
    except _DAMAGE as error:
        raise DataError(path, None, f"not a whole HDF5 file ({error})") from error


def _names(path: Path, file: h5py.File) -> list[str]:
    """Names of all demonstrations, ``demo_2`` before ``demo_10``."""
    try:
        data = file.get("data")
        if isinstance(data, h5py.Group):
            return sorted(data, key=lambda name: (len(name), name))
    except _DAMAGE as error:
        raise DataError(path, "data", f"unreadable ({error})") from error
    raise DataError(path, "data", "missing; valid: a group that holds every demonstration")


def _array(path: Path, file: h5py.File, key: str) -> np.ndarray:
    try:
        node = file.get(key)
        if isinstance(node, h5py.Dataset):
            return np.asarray(node[()])
    except _DAMAGE as error:
        raise DataError(path, key, f"unreadable ({error})") from error
    raise DataError(path, key, "missing" if node is None else "a group; valid: a dataset")


def count_episodes(path: Path) -> int:
    """Number of demonstrations in a file.

    Raises:
        DataError: if the file is missing, damaged or has no ``data`` group.
    """
    with _open(path) as file:
        return len(_names(path, file))


def read_demonstrations(
    path: Path, *, split: str | None = None, observation_keys: Iterable[str] = OBSERVATION_SHAPES
) -> list[dict[str, Any]]:
    """Reads and checks the demonstrations of a file.

    Args:
        path: the HDF5 file.
        split: ``"train"``, ``"valid"`` or ``None`` for all.
        observation_keys: parts of the observation to read.

    Returns:
        one dict per demonstration: ``name``, ``obs`` and ``next_obs`` (dicts of ``(T, n)``),
        ``actions (T, 7)``, ``rewards (T,)``, ``successes (T,)``.

    Raises:
        DataError: naming file and key, for a missing or damaged file, a missing key or mask, wrong
            shapes, values that are not finite, or actions outside [-1, 1].
    """
    observation_keys = list(observation_keys)
    wanted = ["actions", "rewards", "successes"]
    wanted += [f"{group}/{part}" for group in ("obs", "next_obs") for part in observation_keys]
    with _open(path) as file:
        names = _names(path, file)
        if split is not None:
            key = f"mask/{split}"
            mask = _array(path, file, key).reshape(-1)
            chosen = [x.decode(errors="replace") if isinstance(x, bytes) else str(x) for x in mask]
            unknown = sorted(set(chosen) - set(names))
            if unknown:
                raise DataError(path, key, f"names {unknown[0]!r}, which is not in the file")
            names = chosen
        if not names:
            raise DataError(path, f"mask/{split}" if split else "data", "no demonstrations")
        episodes = []
        for name in names:
            arrays = {key: _array(path, file, f"data/{name}/{key}") for key in wanted}
            check_episode(path, f"data/{name}", arrays)
            episodes.append(
                {
                    "name": name,
                    "obs": {part: arrays[f"obs/{part}"] for part in observation_keys},
                    "next_obs": {part: arrays[f"next_obs/{part}"] for part in observation_keys},
                    **{key: arrays[key] for key in ("actions", "rewards", "successes")},
                }
            )
        return episodes
