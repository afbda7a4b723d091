"""Files of D4RL's flat layout, with known rows and ends of episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from episode_files import readers

from torchrl_bmrl.data.d4rl import open_data
from torchrl_bmrl.data.raw import RawEpisode

open_raw, read_metadata, find_oddities = readers(open_data)

# One episode terminates, two are cut by a horizon of 6, the last is not finished.
LENGTHS = {"terminal": 4, "timeout": 6, "again": 6, "rest": 3}
N = sum(LENGTHS.values())
ENDS = (3, 9, 15, 18)
NAMES = ["rows_0_to_3", "rows_4_to_9", "rows_10_to_15", "rows_16_to_18"]


def make_arrays() -> dict[str, Any]:
    """Arrays by key; no two rows of observations or actions are equal."""
    rng = np.random.default_rng(0)
    states = [rng.standard_normal((length + 1, 3)) for length in LENGTHS.values()]
    rows = np.arange(N)
    return {
        "observations": np.concatenate([x[:-1] for x in states]).astype(np.float32),
        "next_observations": np.concatenate([x[1:] for x in states]).astype(np.float32),
        "actions": rng.uniform(-1, 1, (N, 2)).astype(np.float32),
        "rewards": np.isin(rows, ENDS).astype(np.float32),
        "terminals": rows == 3,
        "timeouts": np.isin(rows, (9, 15)),
    }


def write(path: Path, arrays: dict[str, Any], **changes: Any) -> Path:
    """Writes arrays by key; one that is ``None`` is left out."""
    with h5py.File(path, "w") as file:
        for key, array in {**arrays, **changes}.items():
            if array is not None:
                file[key] = array
    return path


def read(path: Path, **options: Any) -> dict[str, RawEpisode]:
    """All episodes of a file by name."""
    with open_raw(path, **options) as episodes:
        return dict(episodes)


def joined(episodes: dict[str, RawEpisode], field: str) -> np.ndarray:
    """An array of all episodes, one after the other."""
    parts = [getattr(raw, field) for raw in episodes.values()]
    return np.concatenate([p["observation"] if isinstance(p, dict) else p for p in parts])
