"""Trains agents on scripted and human demonstrations together, to see whether the latter help.

    python recipes/learn_from_people.py human.path=demo.hdf5
    python recipes/learn_from_people.py human.path=demo.hdf5 "human.shares=[0,0.5]" \
        collect.train_episodes.lift=10

Agents for every share of human transitions in a batch are trained with the same scripted
demonstrations of ``human.task`` and evaluated from the same starts. All are compared with share 0.
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.people import HumanSettings, learn_from_people

add_section("human", HumanSettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, learn_from_people, section="human")


if __name__ == "__main__":
    main()
