"""Exports a run's distilled policy as one small file, with a card and an ONNX file.

    python recipes/export.py run_dir=runs/mine             # after recipes/evaluate.py
    python recipes/export.py evaluate.policy=recipes/policies/sawyer.safetensors  # no run needed

Writes policy.safetensors, policy.md and policy.onnx into the run folder. The first file is enough
for recipes/evaluate.py evaluate.policy=policy.safetensors. The ONNX file runs without this library
(docs/export.md); for an exported policy only this file is written.
"""

from __future__ import annotations

from command import run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.pipeline import export


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, export, trains=False)


if __name__ == "__main__":
    main()
