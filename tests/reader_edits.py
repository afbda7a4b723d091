"""Mutations of arrays that fit several layouts, and the episodes that are mutated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
from episode_files import make_episode
from file_edits import as_group, put, rewrite
from mutations import LINK, Random, as_pairs, as_text

from torchrl_bmrl.data.episodes import Episode

RandomEdit = Callable[[Any, Random], object]
LENGTHS = (5, 6, 7, 4)


def known_episode(number: int, steps: int) -> Episode:
    """An episode of two parts; the second one terminates, the first two succeed at their ends."""
    parts = {"arm": ((3,), np.float64), "touch": ((2,), np.int64)}
    episode = make_episode(number, steps, parts=parts, terminated=number == 1)
    solved = (np.arange(steps) == steps - 1) & (number < 2)
    extras = {"successes": solved, "states": episode.extras["states"]}
    return replace(episode, extras=extras, attributes={"seed": number})


def rename(file: Any, key: str) -> None:
    """Gives an array a name that no layout knows."""
    file.move(key, f"{key}_")


def set_item(array: np.ndarray, index: Any, value: Any) -> np.ndarray:
    """The array with other numbers at an index."""
    array[index] = value
    return array


def as_link(file: Any, key: str, link: Any = LINK) -> None:
    """Replaces an array by a link."""
    put(key, link)(file)


WRECKS: dict[str, Callable[[Any, str, Random], object]] = {
    "a group": lambda file, key, rng: as_group(file, key),
    "dangling link": lambda file, key, rng: as_link(file, key),
    "link to another file": lambda file, key, rng: as_link(
        file, key, h5py.ExternalLink("missing.hdf5", key)
    ),
    "a scalar": lambda file, key, rng: rewrite(file, key, lambda x: x.flat[0]),
    "rows less": lambda file, key, rng: rewrite(file, key, lambda x: x[: -rng.integers(1, 4)]),
    "rows more": lambda file, key, rng: rewrite(
        file, key, lambda x: np.concatenate([x, x[: rng.integers(1, 4)]])
    ),
    "no rows": lambda file, key, rng: rewrite(file, key, lambda x: x[:0]),
    "rows of rows": lambda file, key, rng: rewrite(file, key, lambda x: np.stack([x, x], axis=-1)),
    "text": lambda file, key, rng: rewrite(file, key, as_text),
    "pairs": lambda file, key, rng: rewrite(file, key, as_pairs),
    "complex": lambda file, key, rng: rewrite(file, key, lambda x: x.astype(complex)),
}
"""Edits of an array after which no layout can be read."""


def sparse(length: int, rng: Random) -> np.ndarray:
    """A reward at the last step only."""
    return (np.arange(length) == length - 1) * float(rng.integers(1, 5))


def add_beside(*keys: str) -> RandomEdit:
    """Adds something that no layout knows to one of these groups."""
    values = {"group/x": 1.0, "text": b"a", "numbers": np.zeros(3), "number": 3.0, "link": LINK}

    def edit(file: Any, rng: Random) -> None:
        name = str(rng.choice(list(values)))
        where = keys[int(rng.integers(len(keys)))].format(rng.integers(len(LENGTHS)))
        file[f"{where}/spare_{name}"] = values[name]

    return edit
