"""Starts the server of workers of a recipe before this process imports torch; recipes import this.

The two then import at the same time. Nothing is started by other programs that import a recipe, by
a worker, or for ``--help``, ``--multirun`` and ``workers=1``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from torchrl_bmrl.run.forked import start_server

# torchrl reads this at its import, there and here.
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
_script = getattr(sys.modules["__main__"], "__file__", None)  # a worker has none
_is_recipe = _script is not None and Path(_script).with_name("command.py").exists()
_given = sys.argv[1:]
if _is_recipe and not any(each.startswith("-") or each == "workers=1" for each in _given):
    _sawyer = not any(each.startswith("tasks=") for each in _given)
    start_server("torchrl_bmrl.pipeline", *["torchrl_bmrl.envs.vector"] * _sawyer)
