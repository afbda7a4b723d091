"""Data sets in Minari's layout, written by this library and by Minari itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium.spaces as gym
import minari
import numpy as np
from episode_files import Parts, make_episode, readers
from file_edits import Edit, edit, edit_json
from minari.data_collector import EpisodeBuffer

from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.minari import open_data, write_episodes
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import complete

open_raw, read_metadata, find_oddities = readers(open_data)
ID = "sawyer/lift-v0"
NUMBERS = Path("data") / "main_data.hdf5"
METADATA = Path("data") / "metadata.json"
PARTS: Parts = {
    "wrist": ((34, 36, 3), np.uint8),
    "touch": ((4,), np.uint8),
    "eef_pos": ((3,), np.float64),
    "joints": ((7,), np.float32),
}
BOXES = (gym.Box(-1, 1, (4,), np.float64), gym.Box(-1, 1, (2,), np.float32))
"""Spaces of the observations and the actions of :func:`make_buffer`."""
COMPRESSES_ALL = minari.__version__ == "0.5.3"
"""Whether Minari stores every array of bytes as JPEG: only version 0.5.3 does."""
Damage = Callable[[Path], None]
"""Damages the data set in a folder."""


def minari_episode(seed: int = 0, steps: int = 5, *, terminated: bool = False) -> Episode:
    """An episode with parts of many kinds and a text that is too long for an HDF5 attribute."""
    episode = make_episode(seed, steps, parts=PARTS, terminated=terminated)
    more = {"scale": 0.1, "model_file": "<mujoco>" + "x" * 100_000}
    return replace(episode, attributes={**episode.attributes, **more})


def minari_episodes() -> list[Episode]:
    """Episodes that are truncated, terminated and truncated."""
    return [minari_episode(0, 5), minari_episode(1, 7, terminated=True), minari_episode(2, 4)]


def data_set(root: Path) -> Path:
    """Folder of a new data set of :func:`minari_episodes`."""
    write_episodes(root / ID, iter(minari_episodes()), fps=20, description="lifts")
    return root / ID


@contextmanager
def open_episodes(path: Path) -> Iterator[dict[str, Episode]]:
    """Opens the episodes of a data set; each is read and checked when it is asked for."""
    file = path / NUMBERS
    with open_raw(path) as raws:
        yield LazyEpisodes(raws, lambda name: complete(file, name, raws[name], ReadOptions()))


def read(path: Path) -> list[Episode]:
    """All episodes of a data set."""
    with open_episodes(path) as episodes:
        return list(episodes.values())


# -- as Minari itself writes -----------------------------------------------------------------------


def write_with_minari(
    observation_space: gym.Space, action_space: gym.Space, *buffers: dict[str, Any]
) -> None:
    """Writes a data set under Minari's own root; each buffer is an episode."""
    minari.create_dataset_from_buffers(
        ID,
        [EpisodeBuffer(id=i, **buffer) for i, buffer in enumerate(buffers)],
        observation_space=observation_space,
        action_space=action_space,
    )


def make_buffer(steps: int, *, end: str = "truncations", **changes: Any) -> dict[str, Any]:
    """Contents of an episode in :data:`BOXES`, whose last step has the flag ``end`` if any."""
    rng = np.random.default_rng(steps)
    flags = {name: [False] * steps for name in ("terminations", "truncations")}
    if end in flags:
        flags[end][-1] = True
    return {
        "observations": rng.random((steps + 1, 4)),
        "actions": rng.random((steps, 2)).astype(np.float32),
        "rewards": rng.random(steps),
        **flags,
        **changes,
    }


def smooth(*shape: int) -> np.ndarray:
    """Images that JPEG changes little."""
    return (np.arange(np.prod(shape)) // 3 % 200).astype(np.uint8).reshape(shape)


# -- damage ----------------------------------------------------------------------------------------


def in_numbers(*edits: Edit) -> Damage:
    """Edits the HDF5 file of a data set."""
    return lambda path: edit(path / NUMBERS, *edits)


def in_metadata(**changes: Any) -> Damage:
    """Changes entries of metadata.json; ``None`` removes an entry."""
    return lambda path: edit_json(path / METADATA, **changes)
