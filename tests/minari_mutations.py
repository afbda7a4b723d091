"""Mutations of a data set in Minari's layout, and what h5py alone finds in it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
from file_edits import put, rewrite
from mutations import Random
from reader_edits import (
    LENGTHS,
    WRECKS,
    RandomEdit,
    add_beside,
    known_episode,
    rename,
    set_item,
    sparse,
)

from torchrl_bmrl.data import minari

PARTS = ("observations/arm", "observations/touch")
NEEDED = (*PARTS, "actions", "terminations", "truncations")


def episode_key(file: Any, rng: Random, *keys: str) -> str:
    return f"episode_{rng.integers(len(LENGTHS))}/{rng.choice(keys)}"


def wreck_episode(change: Callable[[Any, str, Random], object]) -> RandomEdit:
    return lambda file, rng: change(file, episode_key(file, rng, "rewards", *NEEDED), rng)


def shorten_episode(file: Any, rng: Random) -> None:
    """Cuts off the end of an episode in all of its arrays, but not in its attributes."""
    name, steps = f"episode_{rng.integers(len(LENGTHS))}", int(rng.integers(1, 4))
    keys: list[str] = []
    file[name].visit(keys.append)
    for key in keys:
        if isinstance(file[f"{name}/{key}"], h5py.Dataset):
            more = int(key.startswith(("observations", "infos")))
            shorter = file[f"{name}/{key}"][: steps + more]
            put(f"{name}/{key}", shorter)(file)


def change_metadata(**changes: Callable[[Any, Random], Any]) -> RandomEdit:
    def edit(file: Any, rng: Random) -> None:
        path = Path(file.filename).with_name("metadata.json")
        metadata = json.loads(path.read_text())
        metadata |= {key: change(metadata[key], rng) for key, change in changes.items()}
        path.write_text(json.dumps(metadata))

    return edit


def change_attribute(key: str, *values: Any) -> RandomEdit:
    def edit(file: Any, rng: Random) -> None:
        name = f"episode_{rng.integers(len(LENGTHS))}"
        file[name].attrs[key] = values[int(rng.integers(len(values)))]

    return edit


def edit_episode(key: str, change: Callable[[np.ndarray, Random], Any]) -> RandomEdit:
    return lambda file, rng: rewrite(
        file, episode_key(file, rng, key), lambda array: change(array, rng)
    )


MINARI: dict[str, tuple[RandomEdit, str | None]] = {
    # The edit; a part of what is reported where the data set loads, None where it is refused.
    **{kind: (wreck_episode(change), None) for kind, change in WRECKS.items()},
    "deleted": (lambda file, rng: file.pop(episode_key(file, rng, "rewards", *NEEDED)), None),
    "another name": (
        lambda file, rng: rename(file, episode_key(file, rng, *NEEDED)),
        None,
    ),
    "a group is gone": (lambda file, rng: file.pop(episode_key(file, rng, "observations")), None),
    "rows of other sizes": (
        lambda file, rng: rewrite(
            file, episode_key(file, rng, *PARTS, "actions"), lambda x: x[:, :-1]
        ),
        None,
    ),
    "actions of integers": (edit_episode("actions", lambda x, rng: x.astype(int)), None),
    "a part of floats": (edit_episode("observations/touch", lambda x, rng: x + 0.5), None),
    "an early end": (
        edit_episode("truncations", lambda x, rng: set_item(x, rng.integers(len(x) - 1), True)),
        None,
    ),
    "half an end": (edit_episode("terminations", lambda x, rng: x + 0.25), None),
    "success of other rows": (
        edit_episode("infos/success", lambda x, rng: x[: rng.integers(0, len(x) - 1)]),
        None,
    ),
    "no episodes": (lambda file, rng: file.clear(), None),
    "an episode is an array": (
        lambda file, rng: (file.pop("episode_2"), file.update({"episode_2": np.zeros(5)})),
        None,
    ),
    "a space of texts": (
        change_metadata(observation_space=lambda old, rng: '{"type": "Text"}'),
        None,
    ),
    "another space": (
        change_metadata(action_space=lambda old, rng: old.replace("[7]", "[8]")),
        None,
    ),
    "sparse rewards": (edit_episode("rewards", lambda x, rng: sparse(len(x), rng)), ""),
    "no reward": (edit_episode("rewards", lambda x, rng: 0 * x), ""),
    "a constant dimension": (edit_episode("observations/arm", lambda x, rng: 0 * x + x[:1]), ""),
    "no success": (edit_episode("infos/success", lambda x, rng: np.zeros_like(x)), ""),
    "success at every step": (edit_episode("infos/success", lambda x, rng: np.ones_like(x)), ""),
    "no infos": (lambda file, rng: file.pop(episode_key(file, rng, "infos")), ""),
    "another length": (shorten_episode, "total_steps contradicts"),
    "an episode less": (lambda file, rng: file.pop(episode_key(file, rng, "")[:-1]), "total_"),
    "an episode more": (
        lambda file, rng: file.copy(f"episode_{rng.integers(4)}", "episode_4"),
        "total_episodes is 4 in metadata.json, the arrays have 5",
    ),
    "beside the episodes": (add_beside(""), "beside the episodes, not read: 'spare_"),
    "beside the arrays": (add_beside("episode_{}", "episode_{}/infos"), "spare_"),
    "beside the parts": (add_beside("episode_{}/observations"), "observations/spare_"),
    "an id": (change_attribute("id", 9, -1, "x", 2.5, [1, 2]), "id contradicts"),
    "total_steps": (change_attribute("total_steps", 9, 0, "x", 5.5), "total_steps contradicts"),
    "another attribute": (change_attribute("new", 3.5, "x", [1, 2], b"\xff"), ""),
    "a wrong total": (
        change_metadata(total_steps=lambda old, rng: old + int(rng.integers(1, 9))),
        "total_steps is",
    ),
    "a wrong count": (
        change_metadata(total_episodes=lambda old, rng: [None, 0, "x", 9][rng.integers(4)]),
        "total_episodes is",
    ),
}


class Minari:
    """A data set in Minari's layout, and what a few lines of h5py find in it."""

    module: ModuleType = minari
    structural = MINARI
    texts = ("metadata.json",)

    def __init__(self, folder: Path) -> None:
        self.source = folder / "sawyer" / "lift-v0"
        minari.write_episodes(self.source, [known_episode(*item) for item in enumerate(LENGTHS)])
        self.file = self.source / "data" / "main_data.hdf5"

    def look(self, file: Any) -> dict[str, dict[str, Any]]:
        """Arrays of each episode by its name."""
        found = {}
        for name in sorted(name for name in file if name[8:].isdigit()):
            group = file[name]
            steps = len(group["actions"])
            success = group.get("infos/success", np.zeros(steps))[()][-steps:]
            found[name] = {
                "obs": {key.split("/")[-1]: group[key][()][:-1] for key in PARTS},
                "next": {key.split("/")[-1]: group[key][()][1:] for key in PARTS},
                "actions": group["actions"][()],
                "rewards": group["rewards"][()],
                "terminated": group["terminations"][()],
                "success": success.any(),
            }
        return found
