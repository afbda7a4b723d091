"""Turns expected errors of a command into one line on stderr and an exit code."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.run.logs import write_line
from torchrl_bmrl.run.stops import stop_on_signals

_SAVED = "finished work is saved, the same command continues it"
_NO_MEMORY = f"error: out of memory; fewer workers need less; {_SAVED}"


@contextmanager
def exit_codes(*, out_of_memory: str = "") -> Iterator[None]:
    """Turns the errors of the block into exit codes.

    The exit code is 1, with one line on stderr, for errors of this library, of the operating system
    (a full disk, a read-only folder) and for lack of memory. It is 128 plus the signal's number for
    a run that was stopped: 143 for SIGTERM, 130 for Ctrl-C. Any other error is a bug and shows its
    traceback.

    Args:
        out_of_memory: advice that is printed when the GPU runs out of memory.

    Raises:
        SystemExit: in all of these cases; its cause is the error.

    Example:
        >>> from torchrl_bmrl.errors import ConfigError
        >>> try:
        ...     with exit_codes():
        ...         raise ConfigError("batch_size must be positive, got 0")
        ... except SystemExit as end:
        ...     print(end.code, end.__cause__)
        1 batch_size must be positive, got 0
    """
    try:
        with stop_on_signals():
            yield
    except StoppedError as stop:
        write_line(str(stop))
        raise SystemExit(128 + stop.signal) from stop
    except KeyboardInterrupt as interrupt:  # the second signal
        write_line(f"interrupted; {_SAVED}")
        raise SystemExit(128 + signal.SIGINT) from interrupt
    except BMRLError as error:
        write_line(f"error: {error}")
        raise SystemExit(1) from error
    except torch.OutOfMemoryError as error:
        reason = str(error).strip().partition("\n")[0]
        write_line(f"error: {'; '.join(filter(None, [reason, out_of_memory, _SAVED]))}")
        raise SystemExit(1) from error
    except (MemoryError, RuntimeError) as error:
        # PyTorch raises a RuntimeError when the CPU's memory is full.
        if not isinstance(error, MemoryError) and "can't allocate memory" not in str(error):
            raise
        write_line(_NO_MEMORY)
        raise SystemExit(1) from error
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        path = f"{error.filename}: " if error.filename is not None else ""
        write_line(f"error: {path}{reason}; {_SAVED}")
        raise SystemExit(1) from error
