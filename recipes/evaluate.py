"""Evaluates the policies from new starts and writes the report.

python recipes/evaluate.py run_dir=runs/mine            # after recipes/distill.py
python recipes/evaluate.py run_dir=runs/more base=runs/mine evaluate.episodes=50  # more of them
python recipes/evaluate.py evaluate.policy=recipes/policies/sawyer.safetensors  # no run needed
"""

from __future__ import annotations

from command import run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.pipeline import evaluate


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, evaluate, trains=False)


if __name__ == "__main__":
    main()
