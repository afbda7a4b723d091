"""Log messages on stderr, for commands; other programs configure the logger themselves.

Every module logs under the name ``torchrl_bmrl``. Worker processes send their records to the
process that started them, so one handler there receives all of them.
"""

from __future__ import annotations

import contextlib
import logging
import sys

from torchrl_bmrl.files import printable

LOGGER = logging.getLogger("torchrl_bmrl")
"""Parent of every logger of this library."""


def write_line(message: str) -> None:
    """Writes a line to stderr as a whole, above the progress bar if there is one.

    A closed or broken stderr is ignored: it must not end a run.

    Args:
        message: the line without its newline, or several lines.

    Example:
        >>> write_line("update 2000 saved")
    """
    message = printable(message, lines=True)
    bars = sys.modules.get("tqdm")  # not imported: no progress bar exists
    with contextlib.suppress(OSError):
        if bars is None:
            sys.stderr.write(f"{message}\n")
        else:
            bars.tqdm.write(f"{message}\n", file=sys.stderr, end="")
        sys.stderr.flush()


class StderrHandler(logging.Handler):
    """Writes log messages with :func:`write_line`."""

    def emit(self, record: logging.LogRecord) -> None:
        """Writes one message."""
        write_line(self.format(record))


def log_to_stderr(*, verbose: bool = False) -> None:
    """Sends the library's log messages to stderr, one line each; commands call this once.

    Args:
        verbose: also show messages of the level ``DEBUG``; otherwise ``INFO`` and above.

    Example:
        >>> log_to_stderr(verbose=True)
        >>> LOGGER.level == logging.DEBUG
        True
        >>> LOGGER.handlers.clear()
    """
    LOGGER.setLevel(logging.DEBUG if verbose else logging.INFO)
    if not any(isinstance(handler, StderrHandler) for handler in LOGGER.handlers):
        LOGGER.addHandler(StderrHandler())
