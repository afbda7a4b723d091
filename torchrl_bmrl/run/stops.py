"""Stops a run between two units of work after a signal, so that finished work is saved."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from torchrl_bmrl.errors import StoppedError

_asked: signal.Signals | None = None


def note_signal(number: int, frame: FrameType | None = None) -> None:
    """Signal handler: the next :func:`check_stop` raises; a second signal raises at once.

    Raises:
        KeyboardInterrupt: at the second signal.
    """
    global _asked
    if _asked is not None:
        raise KeyboardInterrupt
    _asked = signal.Signals(number)


def stop_worker_on_signals() -> None:
    """Makes SIGTERM stop this worker process at its next :func:`check_stop`.

    A terminal or a cluster signals all processes of a run, and the parent process then sends
    SIGTERM. A repeated SIGTERM is the same request, and only the parent handles the other signals.
    """

    def note(number: int, frame: FrameType | None = None) -> None:
        global _asked
        _asked = signal.Signals(number)

    signal.signal(signal.SIGTERM, note)
    for name in ("SIGINT", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def check_stop() -> None:
    """Raises an error if a signal was received; called between two units of work.

    Raises:
        StoppedError: if a signal was received.

    Example:
        >>> with stop_on_signals():
        ...     signal.raise_signal(signal.SIGTERM)  # the current unit of work is finished
        ...     try:
        ...         check_stop()
        ...     except StoppedError as stop:
        ...         print(stop)
        stopped by SIGTERM; finished work is saved, the same command continues it
    """
    if _asked is not None:
        raise StoppedError(_asked)


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Makes Ctrl-C, SIGTERM and SIGHUP stop the block at its next :func:`check_stop`.

    Does nothing outside the main thread, since only that thread may handle signals.

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
    # Ignored signals stay ignored: nohup and background jobs of a shell ignore some.
    numbers = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, note_signal) for number in numbers}
    _asked = None
    try:
        yield
    finally:
        _asked = None
        for number, handler in before.items():
            signal.signal(number, handler)
