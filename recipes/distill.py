"""Stage 2: distils the agents of all tasks into one policy conditioned on an embedding.

python recipes/distill.py run_dir=runs/mine             # after recipes/train_bcq.py
python recipes/distill.py preset=literal run_dir=runs/literal
"""

from __future__ import annotations

from command import run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.pipeline import stage2


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, stage2)


if __name__ == "__main__":
    main()
