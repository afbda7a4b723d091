"""Random episodes, and files of them in robomimic's layout, that several test files share."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from observations import OBSERVATION_SHAPES

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import open_episodes, write_episodes
from torchrl_bmrl.data.schema import arrays_of

Parts = Mapping[str, tuple[tuple[int, ...], Any]]
"""Shape of a row and dtype of each part of an observation."""
PARTS: Parts = {"object": ((10,), np.float64), "image": ((8, 8, 3), np.uint8)}
"""An observation unlike that of the six tasks: files may contain any robot's."""
TASK_PARTS: Parts = {name: ((size,), np.float64) for name, size in OBSERVATION_SHAPES.items()}
LENGTHS = (5, 6, 7, 8)
ENV_ARGS = {"env_name": "BMRLSawyerLift", "type": 1, "env_version": "1", "env_kwargs": {"a": 1}}


def make_episode(
    seed: int = 0, steps: int = 5, *, parts: Parts = PARTS, terminated: bool = False
) -> Episode:
    """Random numbers; each next observation is the following step's observation."""
    rng = np.random.default_rng(seed)
    whole = {
        name: (100 * rng.standard_normal((steps + 1, *shape))).astype(dtype)
        if np.dtype(dtype).kind == "f"
        else rng.integers(0, 100, (steps + 1, *shape)).astype(dtype)
        for name, (shape, dtype) in parts.items()
    }
    return Episode(
        observations={name: part[:-1] for name, part in whole.items()},
        next_observations={name: part[1:] for name, part in whole.items()},
        actions=rng.uniform(-1, 1, (steps, 7)).astype(np.float32),
        rewards=rng.random(steps),
        terminated=np.arange(steps) == (steps - 1 if terminated else -1),
        extras={
            "successes": rng.random(steps) < 0.5,
            "phases": rng.integers(0, 3, steps).astype(np.int8),
            "states": rng.standard_normal((steps, 11)),
        },
        attributes={
            "seed": 2**32 - 1 - seed,
            "phase_names": ["descend", "grasp", "lift"],
            "model_file": f"<mujoco model='{seed}'>{'<geom/>' * 100}</mujoco>",
        },
    )


GROUPS = {"obs": "observations", "next_obs": "next_observations"}
"""Groups of robomimic's layout by the names of an episode's."""


def with_array(episode: Episode, key: str, array: Any) -> Episode:
    """The same episode with another array under a key of robomimic's layout."""
    group, _, name = key.rpartition("/")
    if group in GROUPS:
        parts = {**getattr(episode, GROUPS[group]), name: array}
        return replace(episode, **{GROUPS[group]: parts})
    if key in episode.extras:
        return replace(episode, extras={**episode.extras, key: array})
    return replace(episode, **{key: array})


def changed(key: str, row: int, value: Any) -> Episode:
    """An episode with another number in a row of an array."""
    array = arrays_of(make_episode())[key].copy()
    array.reshape(len(array), -1)[row, -1] = value
    return with_array(make_episode(), key, array)


def file_episodes(lengths: Sequence[int] = LENGTHS, parts: Parts = PARTS) -> list[Episode]:
    """The episodes that :func:`write_file` writes."""
    return [make_episode(i, steps, parts=parts) for i, steps in enumerate(lengths)]


def write_file(
    path: Path, lengths: Sequence[int] = LENGTHS, *, train: int = 3, parts: Parts = PARTS
) -> list[Episode]:
    """Writes episodes of these lengths; the first ``train`` of them are in the mask "train"."""
    episodes = file_episodes(lengths, parts)
    write_episodes(
        path,
        iter(episodes),
        env_args=ENV_ARGS,
        attributes={"task": "lift", "action_noise": 0.2},
        masks={"train": range(train), "valid": range(train, len(lengths))},
    )
    return episodes


def lift_file(folder: Path) -> Path:
    """Path of a new file of four episodes, named lift.hdf5."""
    write_file(folder / "lift.hdf5")
    return folder / "lift.hdf5"


def read_file(path: Path, **options: Any) -> dict[str, Episode]:
    """All episodes of a file by name."""
    with open_episodes(path, **options) as episodes:
        return dict(episodes)


def joined(episodes: Sequence[Episode], group: str, name: str) -> torch.Tensor:
    """One array of all episodes, one after the other."""
    return torch.cat([torch.as_tensor(getattr(episode, group)[name]) for episode in episodes])


def entries(folder: Path) -> list[str]:
    """Sorted names of what is in a folder."""
    return sorted(os.listdir(folder))


def readers(open_data: Any) -> tuple[Any, Any, Any]:
    """Functions that return the episodes, the metadata and the oddities of a data set alone."""

    @contextmanager
    def open_raw(path: Path, **options: Any) -> Iterator[Mapping[str, Any]]:
        with open_data(path, **options) as opened:
            yield opened.episodes

    def read_metadata(path: Path, **options: Any) -> dict[str, Any]:
        with open_data(path, **options) as opened:
            return opened.metadata

    def find_oddities(path: Path, **options: Any) -> list[str]:
        with open_data(path, **options) as opened:
            return list(opened.oddities)

    return open_raw, read_metadata, find_oddities


def assert_same(read: Episode, made: Episode) -> None:
    """Equal to the bit, names, order and dtypes included."""
    for group in ("observations", "next_observations", "extras"):
        ours, theirs = getattr(read, group), getattr(made, group)
        assert set(ours) == set(theirs), group
        for name in theirs:
            assert_identical(ours[name], theirs[name])
    for name in ("actions", "rewards", "terminated"):
        assert_identical(getattr(read, name), getattr(made, name))
    assert dict(read.attributes) == dict(made.attributes)


def assert_identical(ours: Any, theirs: Any) -> None:
    """Equal shapes, dtypes and bits, of arrays or tensors."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    np.testing.assert_array_equal(ours, theirs, strict=True)
    assert ours.tobytes() == theirs.tobytes()
