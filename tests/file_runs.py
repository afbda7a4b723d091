"""Small runs of two tasks from files, without a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from episode_files import write_file

from torchrl_bmrl.pipeline import BCQSettings, DistillSettings, EvaluateSettings, Run, Settings

TASKS = ("door", "drawer")
UPDATES = 6
PARTS = {"arm": ((3,), np.float64)}


def file_run(
    folder: Path,
    *,
    bcq: dict[str, Any] | None = None,
    distill: dict[str, Any] | None = None,
    keep: int = 2,
) -> Run:
    """A run whose demonstrations lie in its folder; see :func:`write_demonstrations`."""
    small = {"batch_size": 4, "num_cells": [8]}
    files = {name: {"demonstrations": str(folder / f"{name}.hdf5")} for name in TASKS}
    return Run(
        Settings(
            run_dir=str(folder),
            workers=1,
            tasks=files,
            bcq=BCQSettings(**({"epochs": 1, "updates_per_epoch": UPDATES, **small} | (bcq or {}))),
            distill=DistillSettings(**({"updates": UPDATES, **small} | (distill or {}))),
            evaluate=EvaluateSettings(episodes=1, num_candidates=3),
            checkpoint_interval=2,
            keep_checkpoints=keep,
        )
    )


def write_demonstrations(folder: Path) -> None:
    """Writes four episodes of each task, of other lengths for each."""
    for index, name in enumerate(TASKS):
        write_file(folder / f"{name}.hdf5", [n + index for n in (5, 6, 7, 8)], parts=PARTS)
