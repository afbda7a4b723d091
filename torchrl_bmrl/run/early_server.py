"""Starts the server of workers of a recipe before this process imports torch; recipes import this.

The two then import at the same time. Nothing is started by other programs that import a recipe, by
a worker, or for ``--help``, ``--multirun`` and ``workers=1``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from torchrl_bmrl.run.forked import start_server

os.environ.setdefault(
    "RL_LOGGING_LEVEL", "WARNING"
)  # read by torchrl at its import, there and here
_script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")  # a worker has none
_given = sys.argv[1:]
if _script.with_name("command.py").exists() and not any(
    argument.startswith("-") or argument == "workers=1" for argument in _given
):
    _sawyer = not any(argument.startswith("tasks=") for argument in _given)
    start_server("torchrl_bmrl.pipeline", *["torchrl_bmrl.envs.vector"] * _sawyer)
