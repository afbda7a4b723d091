"""Imported first by commands: an error of this library at import is one line and exit code 1.

:func:`torchrl_bmrl.run.command_line.exit_codes` does this for what comes after the imports.
"""

from __future__ import annotations

import sys
from types import TracebackType

from torchrl_bmrl.errors import BMRLError


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, BMRLError):
        print(f"error: {error}", file=sys.stderr, flush=True)
    else:
        _before(kind, error, trace)


_before = sys.excepthook
sys.excepthook = _say
