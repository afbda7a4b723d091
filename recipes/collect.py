"""Records demonstrations of the scripted experts, one HDF5 file in robomimic's layout per task.

    python recipes/collect.py                    # 60 + 6 episodes of each task, 80 + 6 of lift
    python recipes/collect.py preset=paper       # the paper's sizes

Finished episodes are saved at once; the same command continues after an interruption.
"""

from __future__ import annotations

from command import run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.pipeline import collect


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, collect)


if __name__ == "__main__":
    main()
