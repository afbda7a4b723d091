"""Mutations of a file in D4RL's layout, and what h5py alone finds in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

from torchrl_bmrl.data import d4rl

FLAT = ("observations/arm", "observations/touch", "actions", "rewards", "terminals", "timeouts")
AFTER = ("next_observations/arm", "next_observations/touch")


def rewrite_all(file: Any, keys: Sequence[str], change: Callable[[np.ndarray], Any]) -> None:
    for key in keys:
        rewrite(file, key, change)


def shift(file: Any) -> None:
    """Takes next observations from the rows that follow, across the ends of episodes."""
    for before, after in zip(FLAT[:2], AFTER, strict=True):
        put(after, np.roll(file[before][()], -1, axis=0))(file)


def flat_key(rng: Random, *keys: str) -> str:
    return str(rng.choice(keys))


def wreck_flat(change: Callable[[Any, str, Random], object]) -> RandomEdit:
    return lambda file, rng: change(file, flat_key(rng, *FLAT, *AFTER), rng)


def edit_flat(key: str, change: Callable[[np.ndarray, Random], Any]) -> RandomEdit:
    return lambda file, rng: rewrite(file, key, lambda array: change(array, rng))


def without(*keys: str) -> RandomEdit:
    return lambda file, rng: [file.pop(key) for key in keys]


def cut_file(file: Any, rng: Random) -> None:
    """Keeps the first rows of all arrays."""
    rows = int(rng.integers(8, sum(LENGTHS) - 5))
    keys: list[str] = []
    file.visit(keys.append)
    for key in keys:
        if isinstance(file[key], h5py.Dataset):
            rewrite(file, key, lambda x: x[:rows])


def shift_without_timeouts(file: Any, rng: Random) -> None:
    shift(file)
    del file["timeouts"]


def end_somewhere(array: np.ndarray, rng: Random) -> np.ndarray:
    return set_item(array, rng.choice(len(array), 3, replace=False), True)


D4RL: dict[str, tuple[RandomEdit, str | None]] = {
    **{kind: (wreck_flat(change), None) for kind, change in WRECKS.items()},
    "deleted": (
        lambda file, rng: file.pop(
            flat_key(rng, "actions", "terminals", "rewards", "observations", *AFTER)
        ),
        None,
    ),
    "another name": (
        lambda file, rng: rename(file, flat_key(rng, "actions", "terminals")),
        None,
    ),
    "ends that nothing tells": (without("timeouts", "next_observations"), None),
    "shifted, without timeouts": (
        shift_without_timeouts,
        None,
    ),
    "rows of other sizes": (
        lambda file, rng: rewrite(file, flat_key(rng, *AFTER), lambda x: x[:, :-1]),
        None,
    ),
    "another dtype": (
        lambda file, rng: rewrite(file, flat_key(rng, *AFTER), lambda x: x.astype(np.float16)),
        None,
    ),
    "NaN": (
        lambda file, rng: rewrite(
            file,
            flat_key(rng, "rewards", "actions", "observations/arm", "next_observations/arm"),
            lambda x: set_item(x, rng.integers(len(x)), np.nan),
        ),
        None,
    ),
    "half an end": (
        lambda file, rng: rewrite(file, flat_key(rng, "terminals", "timeouts"), lambda x: x * 0.5),
        None,
    ),
    "success of other rows": (edit_flat("infos/success", lambda x, rng: x[1:]), None),
    "success of 3": (edit_flat("infos/success", lambda x, rng: x * 3), None),
    "sparse rewards": (edit_flat("rewards", lambda x, rng: sparse(len(x), rng)), ""),
    "no reward": (edit_flat("rewards", lambda x, rng: 0 * x), ""),
    "columns": (
        lambda file, rng: rewrite_all(file, FLAT[3:], lambda x: x[:, None]),
        "",
    ),
    "a constant dimension": (
        lambda file, rng: rewrite_all(file, (FLAT[1], AFTER[1]), np.ones_like),
        "",
    ),
    "no success": (edit_flat("infos/success", lambda x, rng: np.zeros_like(x)), ""),
    "no infos": (without("infos"), ""),
    "no timeouts": (without("timeouts"), "no timeouts: an episode ends at a terminal and where"),
    "no next observations": (without("next_observations"), ""),
    "other terminals": (edit_flat("terminals", end_somewhere), ""),
    "other timeouts": (edit_flat("timeouts", end_somewhere), ""),
    "ends of both kinds": (
        lambda file, rng: rewrite_all(file, FLAT[4:], np.ones_like),
        "22 rows are terminal and timeout at once",
    ),
    "no end": (
        lambda file, rng: rewrite_all(file, FLAT[4:], np.zeros_like),
        "rows 0 to 21 end in neither",
    ),
    "the first rows": (cut_file, ""),
    "shifted": (
        lambda file, rng: shift(file),
        "next_observations is the next episode's first observation",
    ),
    "beside": (add_beside("", "infos"), "spare_"),
    "beside the metadata": (
        lambda file, rng: file.update({"metadata/net/weight": np.zeros((2, 2))}),
        "1 arrays below metadata are not read, such as metadata/net/weight",
    ),
}


class D4rl:
    """A file in D4RL's layout, and what a few lines of h5py find in it."""

    module: ModuleType = d4rl
    structural = D4RL
    texts = ()

    def __init__(self, folder: Path) -> None:
        self.source = self.file = folder / "hopper.hdf5"
        made = [known_episode(*item) for item in enumerate(LENGTHS)]
        last = np.cumsum(LENGTHS) - 1
        rows = np.arange(sum(LENGTHS))
        terminals = np.concatenate([episode.terminated for episode in made])
        arrays: dict[str, Any] = {
            **{f"observations/{k}": [e.observations[k] for e in made] for k in ("arm", "touch")},
            **{f"{k}": [e.next_observations[k.split("/")[-1]] for e in made] for k in AFTER},
            "actions": [episode.actions for episode in made],
            "rewards": [episode.rewards for episode in made],
            "infos/success": [episode.extras["successes"] for episode in made],
            "infos/states": [episode.extras["states"] for episode in made],
            "terminals": [terminals],
            "timeouts": [np.isin(rows, last) & ~terminals],
        }
        with h5py.File(self.file, "w", libver=("v110", "v110")) as file:
            for key, parts in arrays.items():
                file.create_dataset(
                    key, data=np.concatenate(parts), compression="gzip", fletcher32=True
                )

    def look(self, file: Any) -> dict[str, dict[str, Any]]:
        """Arrays of each episode by its name."""
        whole = {
            key: file[key][()]
            for key in (*FLAT, *AFTER, "infos/success", "infos/states")
            if key in file
        }
        steps = len(whole["actions"])
        whole |= {
            key: whole[key].reshape(steps)
            for key in ("rewards", "terminals", "timeouts")
            if key in whole
        }
        if "timeouts" in whole:
            cut = whole["timeouts"]
        else:
            cut = np.zeros(steps, bool)
            for before, after in zip(FLAT[:2], AFTER, strict=True):
                cut[:-1] |= (whole[before][1:] != whole[after][:-1]).any(axis=1)
        ends = [int(row) for row in np.flatnonzero(whole["terminals"] | cut)]
        found, start = {}, 0
        for end in sorted({*ends, steps - 1}):
            rows = slice(start, end + 1)
            found[f"rows_{start}_to_{end}"] = {
                "obs": {key.split("/")[-1]: whole[key][rows] for key in FLAT[:2]},
                "next": {key.split("/")[-1]: whole[key][rows] for key in AFTER}
                if AFTER[0] in whole
                else None,
                "actions": whole["actions"][rows],
                "rewards": whole["rewards"][rows],
                "terminated": whole["terminals"][rows],
                "success": whole.get("infos/success", np.zeros(steps))[rows].any(),
            }
            start = end + 1
        return found
