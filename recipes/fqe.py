"""Fitted Q evaluation: ranks checkpoints without a simulator.

    python recipes/fqe.py run_dir=runs/mine                  # after recipes/collect.py
    python recipes/fqe.py run_dir=runs/mine "fqe.checkpoints=[500,1000,2000]" fqe.updates=1000

Stage 1 trains a series of agents for each task. Fitted Q evaluation estimates each agent's return
from the demonstrations; episodes measure it for comparison. docs/fqe.md explains the table.
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.fqe import FQESettings, fqe

add_section("fqe", FQESettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, fqe, section="fqe")


if __name__ == "__main__":
    main()
