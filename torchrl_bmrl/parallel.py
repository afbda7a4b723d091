"""Jobs over worker processes under one progress bar."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import torch
from tqdm import tqdm

from torchrl_bmrl.errors import BMRLError

Job = TypeVar("Job")
Result = TypeVar("Result")
Report = Callable[[int], None]
"""Called by a job with the number of units that it has finished since its last call."""

_progress: Any = None  # the worker's queue to the bar


def _start_worker(progress: Any) -> None:
    global _progress
    _progress = progress
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # A worker that outlives a killed run would write into the folder of the run that goes on.
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(function: Callable[[Job, Report], Result], job: Job) -> Result:
    return function(job, _progress.put)


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

    Args:
        function: what to do with a job; it calls ``report(n)`` as it advances.
        jobs: its arguments.
        workers: processes; 1 runs everything here.
        total: units over all jobs, for the progress bar and its time left.
        description: what the bar says.
        unit: what it counts.

    Raises:
        BMRLError: if a worker is killed.

    Example:
        >>> run_jobs(
        ...     lambda job, report: 2 * job, [1, 2], workers=1, total=2, description="", unit=""
        ... )
        [2, 4]
    """
    jobs = list(jobs)
    if not jobs:
        return []
    with tqdm(total=total, desc=description, unit=unit, disable=None) as bar:
        if min(workers, len(jobs)) <= 1:
            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            try:
                return [function(job, bar.update) for job in jobs]
            finally:
                torch.set_num_threads(threads)
        try:
            return _run_in_processes(function, jobs, min(workers, len(jobs)), bar)
        except BrokenProcessPool as error:
            raise BMRLError(
                f"{description}: a worker process was killed (out of memory?); what was finished "
                "is kept, the same command goes on"
            ) from error


def _run_in_processes(
    function: Callable[[Job, Report], Result], jobs: list[Job], workers: int, bar: tqdm
) -> list[Result]:
    context = multiprocessing.get_context("spawn")
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # read by the children's numpy at import
    progress: Any = context.Queue()
    executor = ProcessPoolExecutor(workers, context, _start_worker, (progress,))
    try:
        futures = [executor.submit(_run, function, job) for job in jobs]
        pending = set(futures)
        while pending:
            done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
            _drain(progress, bar)
            for future in done:
                future.result()
        return [future.result() for future in futures]
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
        _drain(progress, bar)
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def _drain(progress: Any, bar: tqdm) -> None:
    while True:
        try:
            bar.update(progress.get_nowait())
        except queue.Empty:
            return


def derive_seed(seed: int, *names: str | int) -> int:
    """A 32-bit seed for one purpose: other names, other stream.

    Example:
        >>> derive_seed(0, "collect", "lift", 3) == derive_seed(0, "evaluate", "lift", 3)
        False
    """
    text = "/".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")
