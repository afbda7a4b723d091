"""The whole pipeline: demonstrations, stage 1, stage 2, evaluation, report.

    python recipes/two_stage.py                             # preset quick
    python recipes/two_stage.py preset=smoke seed=1

Started again on the same run folder it goes on where it stopped.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import json
import time
from pathlib import Path

import hydra
from collect import collect
from distill import distill
from evaluate import evaluate
from omegaconf import DictConfig
from settings import Config, run_recipe, tell
from train_bcq import train_all

from torchrl_bmrl.files import read_json, write_atomic

STAGES = {"collect": collect, "stage 1": train_all, "stage 2": distill, "evaluate": evaluate}


def two_stage(config: Config) -> None:
    """Runs the stages one after the other; each skips what it finds done."""
    path = Path(config.run_dir) / "seconds.json"
    seconds = read_json(path, "the seconds of a run") if path.exists() else {}
    for name, stage in STAGES.items():
        started = time.monotonic()
        stage(config)
        # Summed over interruptions, up to the one that was killed.
        seconds[name] = round(seconds.get(name, 0.0) + time.monotonic() - started, 1)
        write_atomic(path, json.dumps(seconds, indent=2) + "\n")
        tell(config, f"{name}: done")
    print(", ".join(f"{name} {value / 60:.1f} min" for name, value in seconds.items()))


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, two_stage)


if __name__ == "__main__":
    main()
