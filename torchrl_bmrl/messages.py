"""What is said on stderr beside progress."""

from __future__ import annotations

import contextlib
import sys


def say(message: str) -> None:
    """Prints a line on stderr, whole: no bar and no line of another thread comes in between.

    A log that nobody takes any more ends no run.

    Args:
        message: the line, without its end; more lines stay together.

    Example:
        >>> say("update 2000 kept")
    """
    bars = sys.modules.get("tqdm")  # where nobody imported it there are none
    with contextlib.suppress(OSError):
        if bars is None:
            sys.stderr.write(f"{message}\n")
        else:
            bars.tqdm.write(f"{message}\n", file=sys.stderr, end="")
        sys.stderr.flush()
