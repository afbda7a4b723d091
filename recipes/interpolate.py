"""Interpolates between the tasks in the embedding, and uses this for exploration.

    python recipes/interpolate.py run_dir=runs/mine      # after recipes/two_stage.py
    python recipes/interpolate.py run_dir=runs/mine interpolation.task=push_up

The same command resumes a study that was stopped (docs/interpolation.md).
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.interpolation import InterpolationSettings, interpolate

add_section("interpolation", InterpolationSettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, interpolate, section="interpolation", trains=False)


if __name__ == "__main__":
    main()
