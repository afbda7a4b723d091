"""Jobs over worker processes, and one account of how far they are."""

from __future__ import annotations

import gc
import hashlib
import logging
import logging.handlers
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.pool import RemoteTraceback  # type: ignore[attr-defined]
from typing import Any, TypeVar

import torch

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.run.logs import LOGGER
from torchrl_bmrl.run.progress import Progress, progress
from torchrl_bmrl.run.stops import check_stop, note_signal

log = logging.getLogger(__name__)

Job = TypeVar("Job")
Result = TypeVar("Result")
Report = Callable[[int], None]
"""Called by a job with the number of units that it has finished since its last call.

It raises :class:`~torchrl_bmrl.errors.StoppedError` when the run was asked to stop: a job that has
more than its last checkpoint catches it, keeps what it has and raises it again.
"""

TRIES = 3
"""So often is a job begun whose worker dies."""
SILENCE = 900.0
"""Seconds without a word after which a worker is taken to hang. Compiling takes one of minutes."""
GRACE = 60.0
"""Seconds that workers have to keep what they did when a run stops."""


def available_cores() -> int:
    """Cores that this process may use.

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
) -> list[Result]:
    """Calls ``function(job, report)`` for every job and returns the results in the jobs' order.

    With more than one worker the jobs run in freshly spawned processes, so ``function`` and the
    jobs must be importable by name. Every job runs on one thread, whatever the number of workers.

    A worker that dies (killed for memory, say), or says nothing for :data:`SILENCE` seconds and so
    is killed, is reported and replaced, and its job done again: a job must be one that can be, from
    the start or from what it kept. What runs here, with one worker, is not watched.

    After a signal (:func:`~torchrl_bmrl.run.stops.stop_on_signals`) every job stops at its next
    report. The same happens to the other jobs when one fails. Workers send their log records here.

    Args:
        function: what to do with a job; it calls ``report(n)`` as it advances.
        jobs: its arguments.
        workers: processes; 1 runs everything here.
        total: units over all jobs, for the time left (:func:`~torchrl_bmrl.run.progress.progress`).
        description: what the jobs do.
        unit: what they count, in the singular.

    Raises:
        BMRLError: if a job's workers die three times.
        StoppedError: if the run was asked to stop.

    Example:
        >>> run_jobs(
        ...     lambda job, report: 2 * job, [1, 2], workers=1, total=2, description="", unit=""
        ... )
        [2, 4]
    """
    jobs = list(jobs)
    if not jobs:
        return []
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
        with _one_thread_each():
            return _run_in_processes(function, jobs, workers, bar, description)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # read by the children's numpy at import
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


class _Worker:
    """A process, and the job that it is at."""

    def __init__(self, function: Callable[[Job, Report], Result]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        level = LOGGER.getEffectiveLevel()
        self.process = context.Process(target=_serve, args=(theirs, function, level), daemon=True)
        self.process.start()
        theirs.close()  # so that the process's end closes the pipe
        self.job = -1  # its number
        self.units = 0  # that the job has reported
        self.heard = time.monotonic()
        self.hangs = False

    def begin(self, number: int, job: Any) -> None:
        self.job, self.units, self.heard = number, 0, time.monotonic()
        self._send(("job", job))

    def end(self) -> None:
        """Asks it to end: at its job's next report, or where it waits for a job."""
        self.process.terminate()
        self._send(("end", None))

    def _send(self, message: tuple[str, Any]) -> None:
        with suppress(OSError):  # if it is dead already, its connection says so next
            self.connection.send(message)

    def kill_if_it_hangs(self) -> None:
        if time.monotonic() - self.heard > SILENCE:
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


def _serve(connection: Connection, function: Callable[[Job, Report], Result], level: int) -> None:
    """A worker's life: jobs in, reports and results out."""
    LOGGER.setLevel(level)
    LOGGER.handlers, LOGGER.propagate = [_SendRecords(connection)], False
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's
    signal.signal(signal.SIGTERM, note_signal)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    gc.freeze()  # imported modules stay; robosuite would search them at every env.close()

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
            connection.send(("result", function(job, report)))
        except StoppedError:
            return
        except Exception as error:
            connection.send(("error", (error, traceback.format_exc())))


def _end_with_parent() -> None:
    # A worker that outlives a killed run would write into the folder of the run that goes on.
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
            by_connection: dict[Any, _Worker] = {worker.connection: worker for worker in pool}
            ready = wait(list(by_connection), timeout=1.0)
            check_stop()
            for worker in pool:
                worker.kill_if_it_hangs()
            for connection in ready:
                worker = by_connection[connection]
                number, worker.heard = worker.job, time.monotonic()
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
                    bar.update(-worker.units)  # to be reported anew
                    deaths[number] += 1
                    what = f"{description}: a worker {value} in job {number + 1} of {len(jobs)}"
                    if deaths[number] == TRIES:
                        raise BMRLError(
                            f"{what}, the {TRIES}rd time; what was finished is kept, the same "
                            "command goes on"
                        )
                    log.warning(f"{what}; the job is done again")
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
        for worker in pool:
            worker.end()  # it keeps what it did
        end = time.monotonic() + GRACE
        for worker in pool:
            worker.process.join(max(0.0, end - time.monotonic()))
            worker.process.kill()
            worker.process.join()


def _death(worker: _Worker) -> str:
    worker.process.join()
    if worker.hangs:
        return f"said nothing for {SILENCE:.0f} s and was killed"
    code = worker.process.exitcode or 0
    return f"was killed by signal {-code} (out of memory?)" if code < 0 else f"ended, code {code},"


def derive_seed(seed: int, *names: str | int) -> int:
    """A 32-bit seed for one purpose: other names, other stream.

    Args:
        seed: of the whole, such as a run.
        *names: of the purpose, such as ``"collect", "lift", 3``.

    Returns:
        a number in [0, 2³²), the same on every machine.

    Example:
        >>> derive_seed(0, "collect", "lift", 3) == derive_seed(0, "evaluate", "lift", 3)
        False
    """
    text = "/".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")
