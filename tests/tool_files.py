"""Files as other tools write them in robomimic's layout, and the ways to read them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from file_edits import Edit
from torchrl.data.datasets import load_dataset

import torchrl_bmrl.data  # noqa: F401  registers the prefix robomimic:
from torchrl_bmrl.data.__main__ import main

EPISODES, STEPS = 4, 20
LAST = np.arange(STEPS) == STEPS - 1
"""Which step of an episode is the last."""


def write(path: Path, *edits: Edit, next_obs: bool = False) -> Path:
    """Writes episodes with reward 1 and done 1 at each last step; edits apply to each."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = "{}"
        for i in range(EPISODES):
            demo, x = file.create_group(f"data/demo_{i}"), rng.standard_normal((STEPS + 1, 3))
            demo["obs/x"] = x[:-1]
            demo["actions"] = rng.uniform(-1, 1, (STEPS, 7))
            demo["rewards"], demo["dones"] = 1.0 * LAST, 1 * LAST
            if next_obs:
                demo["next_obs/x"] = x[1:]
            for edit in edits:
                edit(demo)
    return path


def put_attribute(name: str, value: Any) -> Edit:
    """An edit that gives an episode an attribute; a function computes it from the number."""

    def edit(demo: Any) -> None:
        number = int(demo.name.split("_")[-1])
        demo.attrs[name] = value(number) if callable(value) else value

    return edit


def load(path: Path, **options: Any) -> Any:
    """The replay buffer of a file, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_dataset(f"robomimic:{path}", **options)


def checked(path: Path, capsys: Any, *options: str) -> tuple[int, str, str]:
    """Exit code of the command ``check`` and what it prints to both streams."""
    code = main(["check", str(path), *options])
    printed = capsys.readouterr()
    return code, printed.out, printed.err
