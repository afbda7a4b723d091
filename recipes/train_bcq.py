"""Stage 1: one Batch-Constrained Q-learning agent per task, from demonstrations alone.

python recipes/train_bcq.py run_dir=runs/mine           # after recipes/collect.py
python recipes/train_bcq.py preset=smoke tasks=[lift]
python recipes/train_bcq.py --multirun run_dir=runs/mine workers=1 only=[reach],[lift]
python recipes/train_bcq.py run_dir=runs/mine device=cuda bcq.stacked=true cudagraphs=true
"""

from __future__ import annotations

from command import run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.pipeline import stage1


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, stage1, splits=True)


if __name__ == "__main__":
    main()
