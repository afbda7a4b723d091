"""Imported first by every recipe: one line says which extra is missing."""

import torchrl_bmrl.run.as_command  # noqa: F401
from torchrl_bmrl.extras import needs

with needs("recipes"):
    import hydra  # noqa: F401
    import omegaconf  # noqa: F401
    import tqdm  # noqa: F401
