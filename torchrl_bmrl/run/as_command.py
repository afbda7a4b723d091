"""Prints errors at import, and an interrupt, as one line; commands import this first.

:func:`torchrl_bmrl.run.command_line.exit_codes` handles errors after the imports.
"""

from __future__ import annotations

import sys
from types import TracebackType

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.files import printable


def _print_error(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if isinstance(error, BMRLError):
        print(f"error: {printable(str(error))}", file=sys.stderr, flush=True)
    elif isinstance(error, KeyboardInterrupt):  # Python then ends as SIGINT does
        print("interrupted", file=sys.stderr, flush=True)
    else:
        _default(kind, error, trace)


_default = sys.excepthook
sys.excepthook = _print_error
