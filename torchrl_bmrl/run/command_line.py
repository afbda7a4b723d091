"""How a command ends: one line and an exit code for whatever may be expected to go wrong."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.run.logs import write_line
from torchrl_bmrl.run.stops import stop_on_signals

_KEPT = "what was done is kept, the same command goes on"
_LESS = "fewer workers need less"


@contextmanager
def exit_codes(*, out_of_memory: str = "") -> Iterator[None]:
    """Ends the process as a command should.

    Exit code 1 and one line on stderr for this library's errors, for what the operating system
    refuses (a full disk, a folder that cannot be written) and for want of memory; 128 and the
    signal's number for a run that was asked to stop, 143 for SIGTERM and 130 for Ctrl-C. Any other
    error is a mistake of the program, and shows its traceback.

    Args:
        out_of_memory: what may help when a GPU's memory is not enough.

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
        write_line(f"interrupted; {_KEPT}")
        raise SystemExit(128 + signal.SIGINT) from interrupt
    except BMRLError as error:
        write_line(f"error: {error}")
        raise SystemExit(1) from error
    except torch.OutOfMemoryError as error:
        reason = str(error).strip().partition("\n")[0]
        write_line(f"error: {'; '.join(filter(None, [reason, out_of_memory, _KEPT]))}")
        raise SystemExit(1) from error
    except MemoryError as error:
        write_line(f"error: out of memory; {_LESS}; {_KEPT}")
        raise SystemExit(1) from error
    except RuntimeError as error:
        if "can't allocate memory" not in str(error):  # which PyTorch says of the CPU's
            raise
        write_line(f"error: out of memory; {_LESS}; {_KEPT}")
        raise SystemExit(1) from error
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        path = f"{error.filename}: " if error.filename is not None else ""
        write_line(f"error: {path}{reason}; {_KEPT}")
        raise SystemExit(1) from error
