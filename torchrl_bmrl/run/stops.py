"""Runs that are asked to stop do so between two units of work, with what they did kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from torchrl_bmrl.errors import StoppedError

_asked: signal.Signals | None = None


def note_signal(number: int, frame: FrameType | None = None) -> None:
    """A signal's handler: the next :func:`check_stop` raises, and a second signal at once.

    Raises:
        KeyboardInterrupt: at the second signal.
    """
    global _asked
    if _asked is not None:
        raise KeyboardInterrupt
    _asked = signal.Signals(number)


def check_stop() -> None:
    """Called between two units of work.

    Raises:
        StoppedError: if the process was asked to stop.

    Example:
        >>> with stop_on_signals():
        ...     signal.raise_signal(signal.SIGTERM)  # noted, and what goes on is finished
        ...     try:
        ...         check_stop()
        ...     except StoppedError as stop:
        ...         print(stop)
        stopped by SIGTERM; what was done is kept, the same command goes on
    """
    if _asked is not None:
        raise StoppedError(_asked)


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Has Ctrl-C, SIGTERM and SIGHUP stop the work at its next :func:`check_stop`.

    Only in a process's main thread, which alone may handle signals; elsewhere nothing changes.

    Example:
        >>> with stop_on_signals():
        ...     check_stop()
    """
    global _asked
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    numbers += [signal.SIGHUP] if hasattr(signal, "SIGHUP") else []
    # One that is ignored stays so: nohup, and a shell's background jobs.
    numbers = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, note_signal) for number in numbers}
    _asked = None
    try:
        yield
    finally:
        _asked = None
        for number, handler in before.items():
            signal.signal(number, handler)
