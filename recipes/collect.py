"""Demonstrations of the scripted experts: one robomimic-layout HDF5 file per task.

    python recipes/collect.py                    # 60 + 6 episodes of each task, 80 + 6 of lift
    python recipes/collect.py preset=paper       # the paper's sizes

Killed at any moment it keeps every finished episode; the same command goes on.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from pathlib import Path

import hydra
from omegaconf import DictConfig
from settings import Config, run_recipe

from torchrl_bmrl.data.demonstrations import write_statistics
from torchrl_bmrl.experts.collect import collect_demonstrations


def collect(config: Config) -> None:
    """Collects the demonstrations of every task and the statistics of their observations."""
    data_dir = Path(config.run_dir) / "data"
    collect_demonstrations(
        data_dir,
        {task: config.collect.train_episodes[task] for task in config.tasks},
        valid_episodes=config.collect.valid_episodes,
        noise=config.collect.noise,
        gains=config.collect.gains,
        seed=config.seed,
        workers=config.workers,
        stepper=config.stepper,
        after=config.collect.after,
    )
    write_statistics(data_dir, config.tasks)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, collect)


if __name__ == "__main__":
    main()
