"""The whole pipeline: demonstrations, stage 1, stage 2, evaluation, report.

    python recipes/two_stage.py                             # preset quick
    python recipes/two_stage.py preset=smoke seed=1
    python recipes/two_stage.py tasks=mine.yaml             # tasks of your own (docs/tasks.md)

The same command resumes a run that was stopped.
"""

from __future__ import annotations

from command import run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.pipeline import two_stage


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, two_stage)


if __name__ == "__main__":
    main()
