"""Shows a recipe's docstring in its ``--help``; Hydra imports all modules of this folder."""

from __future__ import annotations

import sys

from omegaconf import OmegaConf

# "$" is escaped, since Hydra's help is a template. replace=True, since Hydra imports this module
# again for each job in a launcher's process.
OmegaConf.register_new_resolver(
    "recipe",
    lambda: (sys.modules["__main__"].__doc__ or "").strip().replace("$", "$$"),
    replace=True,
)
