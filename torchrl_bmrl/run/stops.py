"""Stops a run between two units of work after a signal, so that finished work is saved."""

from __future__ import annotations

import ctypes
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any, TypeVar

from torchrl_bmrl.errors import StoppedError
from torchrl_bmrl.run.forked import FOR_THE_RUN

T = TypeVar("T")
REPEATS = 1.0
"""Seconds in which further signals are the same request.

A closed terminal sends SIGHUP twice, ``timeout`` SIGTERM, and systemd SIGTERM and SIGHUP.
"""
_asked: signal.Signals | None = None
_when = 0.0  # of the first signal


def note_signal(number: int, frame: FrameType | None = None, *, at_once: bool = False) -> None:
    """Signal handler: the next :func:`check_stop` raises; a second request raises at once.

    Args:
        number: the signal.
        frame: not used.
        at_once: whether the first request raises as well.

    Raises:
        KeyboardInterrupt: with the signal's number; not at a signal within :data:`REPEATS` seconds
            after the first.
    """
    global _asked, _when
    now, first = time.monotonic(), _asked is None
    if first:
        _asked, _when = signal.Signals(number), now
    if at_once if first else now - _when > REPEATS:
        raise KeyboardInterrupt(number)


def stop_worker_on_signals() -> None:
    """Makes SIGTERM stop this worker process at its next :func:`check_stop`.

    A terminal or a cluster signals all processes of a run, and the parent process then sends
    SIGTERM. A repeated SIGTERM is the same request, and only the parent handles the other signals.
    """

    def note(number: int, frame: FrameType | None = None) -> None:
        global _asked
        _asked = signal.Signals(number)

    for each in FOR_THE_RUN:
        signal.signal(each, note if each == signal.SIGTERM else signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, FOR_THE_RUN)  # held back since the start


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
def stop_on_signals(*, at_once: bool = False) -> Iterator[None]:
    """Makes Ctrl-C, SIGTERM and SIGHUP stop the block at its next :func:`check_stop`.

    Does nothing outside the main thread, since only that thread may handle signals.

    Args:
        at_once: ``True`` for a block that saves nothing before its end: the signals raise
            ``KeyboardInterrupt``.

    Example:
        >>> with stop_on_signals():
        ...     check_stop()
    """
    global _asked
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # Ignored signals stay ignored: nohup and background jobs of a shell ignore some.
    numbers = [each for each in FOR_THE_RUN if signal.getsignal(each) is not signal.SIG_IGN]
    note = partial(note_signal, at_once=at_once)
    before = {number: signal.signal(number, note) for number in numbers}
    _asked = None
    try:
        yield
    finally:
        _asked = None
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def beside(function: Callable[..., T], *arguments: Any) -> Iterator[Future[T]]:
    """Calls a function in a thread that ends with the block.

    After an error in the block, such as a stop, the thread ends at its next line of Python. If it
    still ran when the process ends, it could abort it.

    Args:
        function: what to call.
        *arguments: its arguments.

    Yields:
        the result to come, or the error.

    Example:
        >>> with beside(sum, [1, 2]) as total:
        ...     total.result()
        3
    """
    future: Future[T] = Future()

    def call() -> None:
        try:
            future.set_result(function(*arguments))
        except BaseException as error:
            future.set_exception(error)

    thread = threading.Thread(target=call)
    thread.start()
    try:
        yield future
    except BaseException:
        # The interpreter has no other way to end a thread that does not ask.
        ctypes.pythonapi.PyThreadState_SetAsyncExc(
            ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit)
        )
        raise
    finally:
        thread.join()


def wait_for(future: Future[T]) -> T:
    """The result of a :func:`beside`, or its error; a stop does not wait for it.

    Args:
        future: the result to come.

    Raises:
        StoppedError: if a signal was received.

    Example:
        >>> with beside(sum, [1, 2]) as total:
        ...     wait_for(total)
        3
    """
    while not future.done():
        check_stop()
        wait([future], timeout=0.2)
    return future.result()
