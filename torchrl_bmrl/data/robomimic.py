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
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.hdf5 import (
    DAMAGE,
    open_file,
    read_array,
    read_attributes,
    read_names,
    read_strings,
    write_attributes,
)
from torchrl_bmrl.data.schema import check_episode, layout_of
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import atomic_path, write_atomic

with needs("data"):
    import h5py

MASKS = ("train", "valid")
STEP_KEYS = ("actions", "rewards", "dones", "terminated", "obs", "next_obs")


@contextmanager
def open_episodes(
    path: str | Path,
    *,
    split: str | None = None,
    observation_keys: Iterable[str] | None = None,
    extras: Iterable[str] | None = None,
    dones_terminate: bool = False,
    attributes: bool = True,
) -> Iterator[Mapping[str, Episode]]:
    """Episodes of a file by name, each read when it is asked for.

    Args:
        path: the HDF5 file; it is only read.
        split: name of a mask, such as ``"train"``; ``None`` for all.
        observation_keys: parts of the observation to read; ``None`` for all.
        extras: further arrays to read, those of them that are there; ``None`` for all that have a
            row of numbers for each step.
        dones_terminate: what ``dones`` means at the last step of files without ``terminated``:
            robomimic's simulators never terminate, so that by default an episode's end truncates.
        attributes: whether to read those of the demonstrations.

    Files without ``next_obs`` take the next step's ``obs``. Their last step is left out, unless it
    terminates: then what follows does not matter, and its own ``obs`` stands for it.

    Raises:
        DataError: naming file and key, for a missing or damaged file, a mask that is missing or
            names a demonstration that is, and, when an episode is read, for missing keys.
        ConfigError: if ``observation_keys`` is one text.

    Example:
        >>> import tempfile
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
    if isinstance(observation_keys, str):
        raise ConfigError(f"observation_keys is {observation_keys!r}; valid: a list of names")
    parts = None if observation_keys is None else list(observation_keys)
    wanted = None if extras is None else set(extras)
    with open_file(path) as file:

        def read(name: str) -> Episode:
            episode = _read_episode(path, file, f"data/{name}", parts, wanted, dones_terminate)
            if not attributes:
                return episode
            told = read_attributes(path, file, f"data/{name}")
            told.pop("num_samples", None)
            return replace(episode, attributes=told)

        yield LazyEpisodes(episode_names(path, file, split), read)


def episode_names(path: str | Path, file: h5py.File, split: str | None) -> list[str]:
    """Names of all demonstrations, or of a mask's.

    Raises:
        DataError: if there are none, or the mask is missing or names one that is.
    """
    names = read_names(path, file, "data")
    if split is not None:
        masks = _read_masks(path, file)
        if split not in masks:
            valid = ", ".join(masks) or "none; the file has no masks"
            raise DataError(path, f"mask/{split}", f"missing; valid masks: {valid}")
        names = _read_mask(path, file, split, set(names))
    if not names:
        raise DataError(path, f"mask/{split}" if split else "data", "no demonstrations")
    return names


def _read_mask(path: str | Path, file: h5py.File, mask: str, known: set[str]) -> list[str]:
    names = read_strings(path, file, f"mask/{mask}")
    seen: set[str] = set()
    for row, name in enumerate(names):
        if name not in known or name in seen:
            fault = "again" if name in known else "which is not in the file"
            raise DataError(path, f"mask/{mask}", f"row {row} names {name!r}, {fault}")
        seen.add(name)
    return names


def find_mask_problems(path: str | Path) -> list[tuple[str, str]]:
    """What is wrong with each mask of a file: key and message."""
    problems = []
    with open_file(path) as file:
        known = set(read_names(path, file, "data"))
        for mask in _read_masks(path, file):
            try:
                _read_mask(path, file, mask, known)
            except DataError as error:
                problems.append((error.key or "mask", error.message))
    return problems


def find_oddities(path: str | Path) -> list[str]:
    """What deserves a look in a file beside its episodes: warnings."""
    oddities = []
    with open_file(path) as file:
        names = read_names(path, file, "data")
        cut = [name for name in names if "next_obs" not in read_names(path, file, f"data/{name}")]
        if cut:
            oddities.append(
                f"{len(cut)} episodes have no next_obs, such as {cut[0]}: where they do not "
                "terminate, their last step is left out"
            )
        present = _read_masks(path, file)
        if set(MASKS) <= set(present):
            train, valid = (set(read_strings(path, file, f"mask/{mask}")) for mask in MASKS)
            if both := sorted(train & valid):
                oddities.append(
                    f"{len(both)} episodes are in train and in valid, such as {both[0]}"
                )
    return oddities


def _read_masks(path: str | Path, file: h5py.File) -> list[str]:
    return read_names(path, file, "mask") if "mask" in read_names(path, file, "/") else []


def _read_episode(
    path: str | Path,
    file: h5py.File,
    demo: str,
    parts: list[str] | None,
    extras: set[str] | None,
    dones_terminate: bool,
) -> Episode:
    present = read_names(path, file, demo)
    if parts is None:
        parts = read_names(path, file, f"{demo}/obs")
    else:
        valid = read_names(path, file, f"{demo}/obs")
        for part in parts:
            if part not in valid:
                raise DataError(path, f"{demo}/obs/{part}", f"missing; valid: {', '.join(valid)}")
    observations = {part: read_array(path, file, f"{demo}/obs/{part}") for part in parts}
    actions = read_array(path, file, f"{demo}/actions")
    if not actions.ndim:
        raise DataError(path, f"{demo}/actions", "one number; valid: (T, action_dim)")
    wanted = [
        key
        for key in present
        if key not in STEP_KEYS
        and (
            _is_extra(path, file, f"{demo}/{key}", len(actions))
            if extras is None
            else key in extras
        )
    ]
    steps: dict[str, np.ndarray] = {"actions": actions}
    steps["rewards"] = read_array(path, file, f"{demo}/rewards")
    if "terminated" in present:
        steps["terminated"] = _read_flags(path, file, f"{demo}/terminated")
    else:
        steps["terminated"] = np.zeros(actions.shape[:1], dtype=bool)
        if dones_terminate:
            dones = _read_flags(path, file, f"{demo}/dones")
            if dones.shape != actions.shape[:1]:
                message = f"shape {dones.shape}; valid: {actions.shape[:1]}"
                raise DataError(path, f"{demo}/dones", message)
            # Some files mark every step at which the task is solved: the episode goes on there.
            steps["terminated"][-1:] = dones[-1:]
    steps |= {key: read_array(path, file, f"{demo}/{key}") for key in wanted}
    if "next_obs" in present:
        after = {part: read_array(path, file, f"{demo}/next_obs/{part}") for part in parts}
    else:
        for key, array in {**steps, **observations}.items():
            if not array.ndim:
                raise DataError(path, f"{demo}/{key}", "one number; valid: a row for each step")
        if steps["terminated"][-1:].any():
            after = {part: np.append(x[1:], x[-1:], axis=0) for part, x in observations.items()}
        else:
            after = {part: array[1:] for part, array in observations.items()}
            observations = {part: array[:-1] for part, array in observations.items()}
            steps = {key: array[:-1] for key, array in steps.items()}
    return Episode(
        observations=observations,
        next_observations=after,
        actions=steps.pop("actions"),
        rewards=steps.pop("rewards"),
        terminated=steps.pop("terminated"),
        extras=steps,
    )


def _is_extra(path: str | Path, file: h5py.File, key: str, steps: int) -> bool:
    """Whether it has a row of numbers for each step; other tools keep all sorts of things."""
    if key.endswith("/successes"):  # this library's own: damage to them is not left alone
        return True
    try:
        node = file[key]
        if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "biuf":
            return False
        return node.shape[:1] == (steps,)
    except DAMAGE as error:
        raise DataError(path, key, f"unreadable ({error})") from error


def _read_flags(path: str | Path, file: h5py.File, key: str) -> np.ndarray:
    flags = read_array(path, file, key)
    wrong = np.flatnonzero((flags != 0) & (flags != 1))
    if len(wrong):
        raise DataError(path, key, f"{flags.flat[wrong[0]]} in row {wrong[0]}; valid: 0 or 1")
    return flags.astype(bool)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Attributes of a file, ``env_args`` parsed, and its masks.

    Returns:
        the attributes by name, and ``masks``: names of demonstrations by mask.

    Raises:
        DataError: if the file is missing or damaged, or ``env_args`` is not JSON.
    """
    with open_file(path) as file:
        read_names(path, file, "data")
        attributes = read_attributes(path, file, "data")
        masks = _read_masks(path, file)
        attributes["masks"] = {name: read_strings(path, file, f"mask/{name}") for name in masks}
    try:
        attributes["env_args"] = json.loads(attributes.get("env_args", "{}"))
    except (TypeError, ValueError) as error:
        raise DataError(path, "data", f"attribute env_args is not JSON ({error})") from error
    if not isinstance(attributes["env_args"], dict):
        raise DataError(path, "data", "attribute env_args; valid: a JSON object")
    return attributes


def count_episodes(path: str | Path) -> int:
    """Number of demonstrations in a file.

    Raises:
        DataError: if the file is missing, damaged or has no ``data`` group.
    """
    with open_file(path) as file:
        return len(read_names(path, file, "data"))


def count_steps(path: str | Path, episodes: Mapping[str, Episode]) -> int:
    """Steps of the episodes of a file together, without reading what need not be read.

    Args:
        path: the file.
        episodes: of :func:`open_episodes`.

    Raises:
        DataError: if the file is damaged or lacks the actions of one.
    """
    total = 0
    with open_file(path) as file:
        for name in episodes:
            key = f"data/{name}/actions"
            try:
                whole = "next_obs" in file[f"data/{name}"]
                total += len(file[key]) if whole else 0
            except DAMAGE as error:
                raise DataError(path, key, f"missing or unreadable ({error})") from error
            total += 0 if whole else len(episodes[name])
    return total


def write_episodes(
    path: str | Path,
    episodes: Iterable[Episode],
    *,
    env_args: Mapping[str, Any],
    attributes: Mapping[str, str | int | float] | None = None,
    masks: Mapping[str, Iterable[int]] | None = None,
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
            check_episode(path, f"data/{names[-1]}", episode, layout=layout)
            layout = layout or layout_of(episode)
            _write_episode(data.create_group(names[-1]), episode)
            total += len(episode)
        if not names:
            raise DataError(path, None, "no episodes; valid: at least one")
        texts = {"env_args": json.dumps(dict(env_args))}
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
