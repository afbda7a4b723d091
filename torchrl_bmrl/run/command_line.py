"""Turns expected errors of a command into one line on stderr and an exit code."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.files import printable
from torchrl_bmrl.run.logs import write_line
from torchrl_bmrl.run.stops import check_stop, stop_on_signals


@contextmanager
def exit_codes(*, out_of_memory: str = "", saves: bool = True) -> Iterator[None]:
    """Turns the errors of the block into exit codes.

    The exit code is 1, with one line on stderr, for errors of this library, of the operating system
    (a full disk, a read-only folder) and for lack of memory. It is 128 plus the signal's number for
    a run that was stopped: 143 for SIGTERM, 130 for Ctrl-C. Any other error is a bug and shows its
    traceback.

    Args:
        out_of_memory: advice that is printed when the GPU runs out of memory.
        saves: ``False`` for a block whose work is saved as a whole, or not at all: a signal ends it
            at once.

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
    saved = ["finished work is saved, the same command continues it"] if saves else []
    try:
        with stop_on_signals(at_once=not saves):
            yield
            check_stop()  # all is done, but a script must not go on to its next command
    except StoppedError as stop:
        write_line(str(stop))
        raise SystemExit(128 + stop.signal) from stop
    except KeyboardInterrupt as interrupt:  # the second signal, or the first if nothing is saved
        write_line("; ".join(["interrupted", *saved]))
        number = signal.SIGINT if saves or not interrupt.args else interrupt.args[0]
        raise SystemExit(128 + number) from interrupt
    except BMRLError as error:
        write_line(f"error: {printable(str(error))}")
        raise SystemExit(1) from error
    except torch.OutOfMemoryError as error:
        reason = str(error).strip().partition("\n")[0]
        write_line(f"error: {'; '.join(filter(None, [reason, out_of_memory, *saved]))}")
        raise SystemExit(1) from error
    except (MemoryError, RuntimeError) as error:
        # PyTorch raises a RuntimeError when the CPU's memory is full.
        if not isinstance(error, MemoryError) and "can't allocate memory" not in str(error):
            raise
        advice = ["fewer workers need less"] if saves else []
        write_line("; ".join(["error: out of memory", *advice, *saved]))
        raise SystemExit(1) from error
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        path = f"{error.filename}: " if error.filename is not None else ""
        write_line("; ".join([f"error: {path}{reason}", *saved]))
        raise SystemExit(1) from error
