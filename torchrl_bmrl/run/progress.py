"""How far a long loop is: a bar on a terminal, plain lines in a log."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from contextlib import AbstractContextManager
from typing import Any, Protocol

from torchrl_bmrl.extras import needs
from torchrl_bmrl.run.logs import write_line

with needs("recipes"):
    from tqdm import tqdm

SOON = 5.0
"""Seconds after which the first line is printed; what is done by then says nothing."""
INTERVAL = 50.0
"""Seconds between two lines, so that no minute is without one."""
WINDOW = 6
"""Lines whose time the rate is taken over: what was read back at the start is soon out of it."""


_whose = ""


def name_lines(whose: str) -> None:
    """Has lines, from now on, begin with a name: those of several runs may share a log.

    Args:
        whose: of what goes on in this process.

    Example:
        >>> name_lines("runs/mine")
        >>> Lines(200, "training", "update").line(now=time.monotonic() + 10)
        'runs/mine: training: 0 of 200 updates (0%), none in the last 0:00:10'
        >>> name_lines("")
    """
    global _whose
    _whose = f"{whose}: " if whose else ""


class Progress(Protocol):
    """What a loop counts on, a bar or lines."""

    n: float

    def update(self, n: float = 1) -> Any:
        """Counts units that are done, or, below 0, to be done again."""


def progress(
    total: int | None, description: str, unit: str, **bar: Any
) -> AbstractContextManager[Progress]:
    """Shows how far a loop is, on stderr: a bar where that is a terminal, else plain lines.

    The first line comes after :data:`SOON` seconds, the others every :data:`INTERVAL` seconds, from
    a thread of their own, whatever the loop does meanwhile; a last one says how long it took.

    Args:
        total: units in all; ``None`` where nobody knows.
        description: what the loop does.
        unit: what it counts, in the singular.
        **bar: further options of the bar, such as ``leave``.

    Example:
        >>> with progress(3, "reading", "episode") as bar:
        ...     for _ in range(3):
        ...         _ = bar.update(1)
        >>> bar.n
        3
    """
    if sys.stderr.isatty():
        return tqdm(total=total, desc=description, unit=unit, **bar)
    return Lines(total, description, unit)


class Lines:
    """Progress as lines that a log file can hold; see :func:`progress`.

    Args:
        total: units in all, or ``None``.
        description: what is done.
        unit: what is counted, in the singular.

    Example:
        >>> lines = Lines(200, "training", "update")
        >>> with lines:
        ...     lines.update(50)
        >>> lines.line(now=lines.started + 10)
        'training: 50 of 200 updates (25%), 5 updates/s, 0:00:30 left'
    """

    def __init__(self, total: int | None, description: str, unit: str) -> None:
        self.total, self.description, self.unit = total, description, unit
        self.n: float = 0
        self.started = time.monotonic()
        self.said: deque[tuple[float, float]] = deque([(self.started, 0)], maxlen=WINDOW)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._print, daemon=True)

    def __enter__(self) -> Lines:
        self.thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.ended.set()
        self.thread.join()
        if kind is None and len(self.said) > 1:
            seconds = time.monotonic() - self.started
            write_line(f"{self._where()}, done in {_duration(seconds)}")

    def update(self, n: float = 1) -> None:
        """Counts units that are done, or, below 0, to be done again."""
        self.n += n

    def line(self, now: float) -> str:
        """What is printed at a moment of ``time.monotonic()``."""
        before, done = self.said[0]
        rate = (self.n - done) / max(now - before, 1e-9)
        self.said.append((now, self.n))
        if rate <= 0:
            return f"{self._where()}, none in the last {_duration(now - before)}"
        parts = [self._where(), self._speed(rate)]
        if self.total is not None:
            parts.append(f"{_duration(max(self.total - self.n, 0) / rate)} left")
        return ", ".join(parts)

    def _where(self) -> str:
        where = f"{self.n:,.0f}"
        if self.total is not None:
            where += f" of {self.total:,}"
        where += f" {self.unit}s"
        if self.total:
            where += f" ({self.n / self.total:.0%})"
        return f"{_whose}{self.description}: {where}"

    def _speed(self, rate: float) -> str:
        per = "s" if rate >= 1 else "min" if rate >= 1 / 60 else "h"
        speed = rate * {"s": 1, "min": 60, "h": 3600}[per]
        number = f"{speed:,.0f}" if speed >= 100 else f"{speed:.3g}"
        return f"{number} {self.unit}s/{per}"

    def _print(self) -> None:
        pause = SOON
        while not self.ended.wait(pause):
            write_line(self.line(time.monotonic()))
            pause = INTERVAL


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"
