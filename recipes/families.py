"""Plays unseen tasks: held-out members of the run's family.

    python recipes/two_stage.py preset=family run_dir=runs/push
    python recipes/families.py run_dir=runs/push

The same command resumes a study that was stopped (docs/families.md).
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.families import generalise
from torchrl_bmrl.studies.families_methods import FamilySettings

add_section("families", FamilySettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, generalise, section="families")


if __name__ == "__main__":
    main()
