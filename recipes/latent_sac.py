"""SAC whose action is m, which the frozen distilled policy executes.

    python recipes/latent_sac.py run_dir=runs/mine      # after recipes/two_stage.py preset=compose
    python recipes/latent_sac.py run_dir=runs/mine latent_sac.composition=lift-reach

Finished agents are skipped; an interrupted one starts again (docs/latent_sac.md).
"""

from __future__ import annotations

from command import add_section, run_recipe

# isort: split
import hydra
from omegaconf import DictConfig

from torchrl_bmrl.studies.latent_sac import LatentSACSettings, latent_sac

add_section("latent_sac", LatentSACSettings)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, latent_sac, section="latent_sac", trains=False)


if __name__ == "__main__":
    main()
