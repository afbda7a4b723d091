"""A recipe's docstring in its ``--help``; Hydra imports what lies in this folder when it starts."""

from __future__ import annotations

import sys

from omegaconf import OmegaConf

# Of the script that was started. What looks like a variable there is not one of Hydra's template.
# Replaced: in a launcher's process Hydra imports this anew for each job.
OmegaConf.register_new_resolver(
    "recipe",
    lambda: (sys.modules["__main__"].__doc__ or "").strip().replace("$", "$$"),
    replace=True,
)
