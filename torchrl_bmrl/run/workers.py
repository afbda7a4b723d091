"""Runs jobs in worker processes, with one progress bar for all of them."""

from __future__ import annotations

import gc
import hashlib
import logging
import logging.handlers
import multiprocessing
import os
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.pool import RemoteTraceback  # type: ignore[attr-defined]
from typing import Any, TypeVar

import torch

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.run.forked import METHOD, held_signals, one_thread, start_server
from torchrl_bmrl.run.logs import LOGGER
from torchrl_bmrl.run.progress import Progress, progress
from torchrl_bmrl.run.stops import check_stop, stop_worker_on_signals

log = logging.getLogger(__name__)

Job = TypeVar("Job")
Result = TypeVar("Result")
Report = Callable[[int], None]
"""Called by a job with the number of units that it has finished since its last call.

It raises :class:`~torchrl_bmrl.errors.StoppedError` when the run is stopped. A job with unsaved
work catches that error, saves the work and raises it again.
"""

TRIES = 3
"""How often a job is started before the run fails, if its worker dies each time."""
SILENCE = 900.0
"""Seconds without a report after which a worker counts as hung; compiling can take minutes.

Only seconds in which this process waits for reports count: not those of a suspended job.
"""
PATIENCE = 1.0
"""Seconds of one wait for reports."""
GRACE = 60.0
"""Seconds that workers have to save their work when a run stops."""


def available_cores() -> int:
    """Returns the number of cores that this process may use.

    Example:
        >>> available_cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_jobs(
    function: Callable[[Job, Report], Result],
    jobs: Sequence[Job],
    *,
    workers: int,
    total: int,
    description: str,
    unit: str,
    preload: Iterable[str] = (),
) -> list[Result]:
    """Calls ``function(job, report)`` for every job and returns the results in the jobs' order.

    With more than one worker the jobs run in new processes, so ``function`` and the jobs must be
    importable by name. Every job uses one thread. Log records of workers reach this process. On
    Linux workers share what they import (:mod:`torchrl_bmrl.run.forked`).

    If a worker dies, for example for lack of memory, a warning is logged and another worker runs
    the job again, from its start or its last checkpoint. A worker that reports nothing for
    :data:`SILENCE` seconds is killed first. With one worker nothing of this is done.

    After a signal (:func:`~torchrl_bmrl.run.stops.stop_on_signals`), or when another job fails,
    every job stops at its next report.

    Args:
        function: runs one job and calls ``report(n)`` as it advances.
        jobs: the arguments of ``function``.
        workers: number of processes; with 1 everything runs in this process.
        total: units of all jobs, for the progress (:func:`~torchrl_bmrl.run.progress.progress`).
        description: name of the jobs, such as ``"training"``.
        unit: name of a unit, in the singular.
        preload: modules that the jobs import and this process does not, such as a simulator's.

    Raises:
        BMRLError: if a job's workers die three times.
        StoppedError: if the run is stopped.

    Example:
        >>> run_jobs(
        ...     lambda job, report: 2 * job, [1, 2], workers=1, total=2, description="", unit=""
        ... )
        [2, 4]
    """
    jobs = list(jobs)
    if not jobs:
        return []
    check_stop()
    with progress(total, description, unit) as bar:
        if min(workers, len(jobs)) <= 1:

            def report(units: int) -> None:
                bar.update(units)
                check_stop()

            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            try:
                return [function(job, report) for job in jobs]
            finally:
                torch.set_num_threads(threads)
        start_server(function.__module__, *preload)
        with one_thread():
            return _run_in_processes(function, jobs, workers, bar, description)


class _Worker:
    """A worker process and its current job."""

    def __init__(self, function: Callable[[Job, Report], Result]) -> None:
        context: Any = multiprocessing.get_context(METHOD)
        self.connection, theirs = context.Pipe()
        level = LOGGER.getEffectiveLevel()
        arguments = (theirs, function, level, dict(os.environ))
        self.process = context.Process(target=_serve, args=arguments, daemon=True)
        with held_signals():
            self.process.start()
        theirs.close()  # so that the process's end closes the pipe
        self.job = -1  # number of the job
        self.units = 0  # units that the job has reported
        self.silence = 0.0  # seconds that this process has waited for a message of it
        self.hangs = False

    def begin(self, number: int, job: Any) -> None:
        self.job, self.units, self.silence = number, 0, 0.0
        self._send(("job", job))

    def end(self) -> None:
        """Stops the worker at its job's next report, or at once if it waits for a job."""
        self.process.terminate()
        self._send(("end", None))

    def _send(self, message: tuple[str, Any]) -> None:
        with suppress(OSError):  # a dead worker is noticed when its connection is read
            self.connection.send(message)

    def kill_if_it_hangs(self) -> None:
        if self.silence > SILENCE:
            self.hangs = True
            self.process.kill()


class _SendRecords(logging.handlers.QueueHandler):
    """Sends a worker's log records to the process that started it."""

    def __init__(self, connection: Connection) -> None:
        super().__init__(None)  # type: ignore[arg-type]  # there is no queue
        self.connection = connection

    def enqueue(self, record: logging.LogRecord) -> None:
        with suppress(OSError):
            self.connection.send(("log", record))


def _serve(
    connection: Connection,
    function: Callable[[Job, Report], Result],
    level: int,
    environment: dict[str, str],
) -> None:
    """Main loop of a worker: receives jobs, sends reports and results."""
    os.environ.clear()  # a forked worker has that of its server
    os.environ.update(environment)
    if (numpy := sys.modules.get("numpy")) is not None:
        numpy.random.seed()  # and the random state: without a seed, all would draw the same
    LOGGER.setLevel(level)
    LOGGER.handlers, LOGGER.propagate = [_SendRecords(connection)], False
    torch.set_num_threads(1)
    stop_worker_on_signals()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    gc.freeze()  # robosuite collects garbage at every env.close(): leave imported modules out

    def report(units: int) -> None:
        connection.send(("report", units))
        check_stop()

    while True:
        try:
            kind, job = connection.recv()
        except EOFError:
            return
        if kind == "end":
            return
        try:
            check_stop()  # the signal may have come while this worker started
            connection.send(("result", function(job, report)))
        except StoppedError:
            return
        except Exception as error:
            connection.send(("error", (error, traceback.format_exc())))


def _end_with_parent() -> None:
    # A worker that outlives a killed run would write into the folder of the continued run.
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run_in_processes(
    function: Callable[[Job, Report], Result],
    jobs: list[Job],
    workers: int,
    bar: Progress,
    description: str,
) -> list[Result]:
    waiting, deaths = deque(range(len(jobs))), Counter[int]()
    results: dict[int, Result] = {}
    pool: list[_Worker] = []
    try:
        while len(results) < len(jobs):
            while waiting and len(pool) < workers:
                pool.append(_Worker(function))
                pool[-1].begin(number := waiting.popleft(), jobs[number])
            ready, _ = _wait(pool)
            check_stop()
            for worker in pool:
                worker.kill_if_it_hangs()
            for worker in ready:
                number = worker.job
                try:
                    kind, value = worker.connection.recv()
                except (EOFError, OSError):
                    kind, value = "death", _death(worker)
                if kind == "log":
                    logging.getLogger(value.name).handle(value)
                elif kind == "report":
                    worker.units += value
                    bar.update(value)
                elif kind == "error":
                    error, text = value
                    raise error from RemoteTraceback(text)
                elif kind == "death":
                    pool.remove(worker)
                    bar.update(-worker.units)  # the retried job reports them again
                    deaths[number] += 1
                    what = f"{description}: a worker {value} in job {number + 1} of {len(jobs)}"
                    if deaths[number] == TRIES:
                        raise BMRLError(
                            f"{what} for the {TRIES}rd time; finished work is saved, the same "
                            "command continues it"
                        )
                    log.warning(f"{what}; the job is retried")
                    waiting.appendleft(number)
                else:
                    results[number] = value
                    if waiting:
                        worker.begin(number := waiting.popleft(), jobs[number])
                    else:
                        pool.remove(worker)
                        worker.connection.close()
                        worker.process.join()
        return [results[number] for number in range(len(jobs))]
    finally:
        _end(pool)


def _wait(pool: Sequence[_Worker]) -> tuple[list[_Worker], float]:
    """Waits for messages; returns the workers that sent one, and how long this waited [s].

    A pause of this process (Ctrl-Z, a suspended laptop) hardly counts, and ends with the messages
    that were sent meanwhile.
    """
    began = time.monotonic()
    found = wait([worker.connection for worker in pool], timeout=PATIENCE)
    waited = min(time.monotonic() - began, PATIENCE)
    ready = [worker for worker in pool if worker.connection in found]
    for worker in pool:
        worker.silence = 0.0 if worker in ready else worker.silence + waited
    return ready, waited


def _end(pool: Sequence[_Worker]) -> None:
    """Ends workers; to save their work they have :data:`GRACE` seconds."""
    for worker in pool:
        worker.end()
    left, open_ = GRACE, list(pool)
    try:
        while open_ and left > 0:
            ready, waited = _wait(open_)
            left -= waited
            for worker in ready:  # a worker whose messages nobody reads waits, and saves nothing
                try:
                    worker.connection.recv_bytes()
                except (EOFError, OSError):
                    open_.remove(worker)
        for worker in pool:
            worker.process.join(max(0.0, left))
    finally:  # a second signal interrupts the wait
        for worker in pool:
            worker.process.kill()
            worker.process.join()


def _death(worker: _Worker) -> str:
    worker.process.join()
    if worker.hangs:
        return f"reported nothing for {SILENCE:.0f} s and was killed"
    code = worker.process.exitcode or 0
    if code < 0:
        return f"was killed by signal {-code} (out of memory?)"
    return f"ended with code {code}"


def derive_seed(seed: int, *names: str | int) -> int:
    """Derives a 32-bit seed for one purpose; other names give an independent stream.

    Args:
        seed: the seed of the run.
        *names: the purpose, such as ``"collect", "lift", 3``.

    Returns:
        a number in [0, 2³²), the same on every machine.

    Example:
        >>> derive_seed(0, "collect", "lift", 3) == derive_seed(0, "evaluate", "lift", 3)
        False
    """
    text = "/".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")
