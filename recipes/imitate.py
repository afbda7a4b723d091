"""One-shot imitation: one demonstration of a composition drives the distilled policy.

    python recipes/imitate.py run_dir=runs/mine      # after recipes/two_stage.py preset=compose
    python recipes/imitate.py run_dir=runs/mine imitate.composition=reach-lift

The same command resumes a study that was stopped (docs/imitation.md).
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.imitation import ImitateSettings, imitate

add_section("imitate", ImitateSettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, imitate, section="imitate", trains=False)


if __name__ == "__main__":
    main()
