"""Progress of long loops: a bar on a terminal, plain lines in a log file."""

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
"""Seconds until the first line; a shorter loop prints nothing."""
INTERVAL = 50.0
"""Seconds between two lines, so that there is one in every minute."""
WINDOW = 6
"""Lines that the rate is averaged over; results loaded at the start soon no longer count."""


_prefix = ""


def name_lines(prefix: str) -> None:
    """Sets a prefix for all progress lines of this process: several runs may share a log.

    Args:
        prefix: the prefix without its colon; ``""`` for none.

    Example:
        >>> name_lines("runs/mine")
        >>> Lines(200, "training", "update").line(now=time.monotonic() + 10)
        'runs/mine: training: 0 of 200 updates (0%), none in the last 0:00:10'
        >>> name_lines("")
    """
    global _prefix
    _prefix = f"{prefix}: " if prefix else ""


class Progress(Protocol):
    """A progress bar, or :class:`Lines`."""

    n: float

    def update(self, n: float = 1) -> Any:
        """Adds finished units; a negative number takes back those of a job that is retried."""


def progress(
    total: int | None, description: str, unit: str, **bar: Any
) -> AbstractContextManager[Progress]:
    """Shows the progress of a loop on stderr: as a bar on a terminal, else as plain lines.

    A thread prints the first line after :data:`SOON` seconds and the others every :data:`INTERVAL`
    seconds. The last line contains the duration.

    Args:
        total: number of units; ``None`` if it is unknown.
        description: name of the loop, such as ``"training"``.
        unit: name of a unit, in the singular.
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
    """Progress as plain lines, for log files; the arguments are those of :func:`progress`.

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
        self.printed: deque[tuple[float, float]] = deque([(self.started, 0)], maxlen=WINDOW)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._print, daemon=True)

    def __enter__(self) -> Lines:
        self.thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.ended.set()
        self.thread.join()
        if kind is None and len(self.printed) > 1:
            seconds = time.monotonic() - self.started
            write_line(f"{self._where()}, done in {_duration(seconds)}")

    def update(self, n: float = 1) -> None:
        """Adds finished units; a negative number takes units back."""
        self.n += n

    def line(self, now: float) -> str:
        """Returns the line for a time of ``time.monotonic()``."""
        before, done = self.printed[0]
        rate = (self.n - done) / max(now - before, 1e-9)
        self.printed.append((now, self.n))
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
        return f"{_prefix}{self.description}: {where}"

    def _speed(self, rate: float) -> str:
        seconds = {"s": 1, "min": 60, "h": 3600}
        # Three digits, as printed: the last digits of the clock must not choose the unit.
        per = next((unit for unit in seconds if float(f"{rate * seconds[unit]:.3g}") >= 1), "h")
        speed = rate * seconds[per]
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
