"""Baselines: other offline algorithms on the same demonstrations, played from the same starts.

    python recipes/baselines.py run_dir=runs/mine             # after recipes/collect.py
    python recipes/baselines.py run_dir=runs/mine "baselines.algorithms=[bc,bcq_one_hot]"
    python recipes/baselines.py run_dir=runs/mine +baselines.coefficients.td3_bc.alpha=1

BC, BC of the best episodes, TD3+BC, ReBRAC, IQL and CQL, one policy per task, and one BCQ for all
tasks whose observation contains the task's one-hot index. The same command resumes a run that was
stopped.
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.baselines import BaselineSettings, baselines

add_section("baselines", BaselineSettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, baselines, section="baselines")


if __name__ == "__main__":
    main()
