"""Jobs over processes: order, equality, what happens when one is killed."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("tqdm")

from torchrl_bmrl.errors import (
    BMRLError,
    CheckpointError,
    ConfigError,
    DataError,
    StoppedError,
    UnknownNameError,
)
from torchrl_bmrl.run import workers
from torchrl_bmrl.run.progress import Lines
from torchrl_bmrl.run.stops import stop_on_signals
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs

OPTIONS: dict[str, Any] = {"total": 8, "description": "stage 1: training", "unit": "update"}


def work(job: tuple[int, float], report: Report) -> dict[str, Any]:
    """A draw after a pause, so that jobs do not finish in their order."""
    number, pause = job
    torch.manual_seed(derive_seed(0, "work", number))
    time.sleep(pause)
    report(2)
    product = torch.randn(64, 64) @ torch.randn(64, 64)
    return {"number": number, "sum": product.sum().item(), "threads": torch.get_num_threads()}


def fail(job: str, report: Report) -> None:
    raise CheckpointError(f"runs/{job}", "no manifest")


JOBS = [(0, 0.5), (1, 0.0), (2, 0.1), (3, 0.0)]


@pytest.mark.slow
def test_two_workers_give_the_results_of_one_in_the_jobs_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    two = run_jobs(work, JOBS, workers=2, **OPTIONS)
    one = run_jobs(work, JOBS, workers=1, **OPTIONS)
    assert [result["number"] for result in two] == [0, 1, 2, 3]
    assert {result["threads"] for result in two} == {1}
    assert one == two
    assert "OMP_NUM_THREADS" not in os.environ


def count_left_alone(job: int, report: Report) -> int:
    return gc.get_freeze_count()


@pytest.mark.slow
def test_workers_do_not_search_what_was_imported_whenever_an_environment_closes() -> None:
    assert min(run_jobs(count_left_alone, [0, 1], workers=2, **OPTIONS)) > 100_000


def die_until(job: tuple[str, Path, int], report: Report) -> str:
    """Reports one unit and is killed, so often; then reports two and returns."""
    name, folder, deaths = job
    report(1)
    tries = folder / name
    tries.write_text(tries.read_text() + "x" if tries.exists() else "x")
    if len(tries.read_text()) <= deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    report(1)
    return name


@pytest.mark.slow
def test_the_job_of_a_killed_worker_is_reported_and_done_again_and_no_other(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    updates: list[int] = []
    bar = type("Bar", (Lines,), {"update": lambda bar, n: updates.append(n)})
    monkeypatch.setattr(workers, "progress", bar)
    jobs = [(name, tmp_path, deaths) for name, deaths in zip("abcd", (0, 2, 0, 0), strict=True)]
    assert run_jobs(die_until, jobs, workers=2, **OPTIONS) == ["a", "b", "c", "d"]
    assert [len((tmp_path / name).read_text()) for name in "abcd"] == [1, 3, 1, 1]
    assert sum(updates) == 8
    assert updates.count(-1) == 2
    said = [line for line in caplog.messages if "killed" in line]
    assert len(said) == 2
    assert "a worker was killed by signal 9 (out of memory?) in job 2 of 4" in said[0]
    assert "retried" in said[1]


@pytest.mark.slow
def test_a_job_that_kills_its_worker_every_time_ends_the_run_with_a_message(
    tmp_path: Path,
) -> None:
    jobs = [("fine", tmp_path, 0), ("killed", tmp_path, 9)]
    with pytest.raises(BMRLError, match=r"stage 1: training: a worker was killed.* 3rd time"):
        run_jobs(die_until, jobs, workers=2, **OPTIONS)
    assert len((tmp_path / "killed").read_text()) == workers.TRIES


def fail_unexpectedly(job: int, report: Report) -> None:
    raise ZeroDivisionError(f"job {job}")


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_an_unexpected_error_of_a_worker_comes_with_its_traceback_and_the_others_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(workers, "GRACE", 3600.0)  # nobody has to be killed
    with pytest.raises(ZeroDivisionError, match="job 1") as caught:
        run_jobs(fail_unexpectedly, [1, 1], workers=2, **OPTIONS)
    assert "in fail_unexpectedly" in str(caught.value.__cause__)


@pytest.mark.slow
def test_an_expected_error_of_a_worker_arrives_whole() -> None:
    with pytest.raises(CheckpointError, match="runs/lift"):
        run_jobs(fail, ["lift", "lift"], workers=2, **OPTIONS)


def hang_once(job: tuple[str, Path], report: Report) -> str:
    """The first worker at a job reports one unit and says nothing more."""
    name, folder = job
    report(1)
    if name == "hangs" and not (folder / name).exists():
        (folder / name).touch()
        time.sleep(600)
    report(1)
    return name


@pytest.mark.slow
def test_a_worker_that_hangs_is_named_and_killed_and_its_job_done_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Long enough for a process to start and import this.
    monkeypatch.setattr(workers, "SILENCE", 20.0)
    jobs = [("hangs", tmp_path), ("fine", tmp_path)]
    assert run_jobs(hang_once, jobs, workers=2, **OPTIONS) == ["hangs", "fine"]
    said = caplog.text
    assert "a worker reported nothing for 20 s and was killed in job 1 of 2; the job is" in said


def work_until_stopped(job: tuple[str, Path], report: Report) -> None:
    """Keeps what it did when it is stopped; ``fails`` fails when all others are at work."""
    name, folder = job
    done = 0
    try:
        (folder / f"{name}.pid").write_text(str(os.getpid()))
        (folder / f"{name}.pid").rename(folder / f"{name}.started")
        while True:
            time.sleep(0.01)
            done += 1
            if name == "fails" and len(list(folder.glob("*.started"))) == 2:
                raise CheckpointError("runs/lift", "no manifest")
            report(1)
    except StoppedError:
        time.sleep(0.2)  # a signal that comes meanwhile must not end it
        (folder / name).write_text(str(done))
        raise


def signal_when_all_work(
    folder: Path, names: str, number: signal.Signals, *, group: bool
) -> threading.Thread:
    """Signals this process when every job has started, and with ``group`` the workers as well."""

    def wait() -> None:
        started = [folder / f"{name}.started" for name in names]
        while not all(file.exists() for file in started):
            time.sleep(0.05)
        for pid in {os.getpid(), *(int(file.read_text()) for file in started if group)}:
            os.kill(pid, number)

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


@pytest.mark.slow
@pytest.mark.usefixtures("signals_not_ignored")
@pytest.mark.parametrize(
    ("workers", "names", "number", "group"),
    [
        (1, "a", signal.SIGTERM, False),
        (2, "ab", signal.SIGTERM, False),
        (2, "ab", signal.SIGINT, True),  # Ctrl-C
        (2, "ab", signal.SIGTERM, True),  # a cluster's time limit
        (2, "ab", signal.SIGHUP, True),  # a closed terminal
    ],
)
def test_asked_to_stop_every_job_keeps_what_it_did(
    tmp_path: Path, workers: int, names: str, number: signal.Signals, group: bool
) -> None:
    jobs = [(name, tmp_path) for name in names]
    with stop_on_signals():
        thread = signal_when_all_work(tmp_path, names, number, group=group)
        with pytest.raises(StoppedError, match=number.name):
            run_jobs(work_until_stopped, jobs, workers=workers, **OPTIONS)
    thread.join()
    for name in names:
        assert int((tmp_path / name).read_text()) >= 1


@pytest.mark.slow
def test_when_a_job_fails_the_others_keep_what_they_did(tmp_path: Path) -> None:
    jobs = [("other", tmp_path), ("fails", tmp_path)]
    with pytest.raises(CheckpointError, match="no manifest"):
        run_jobs(work_until_stopped, jobs, workers=2, **OPTIONS)
    assert int((tmp_path / "other").read_text()) >= 1


def say_nothing(job: str, report: Report) -> None:
    os.write(1, b"started\n")  # whole: both start at once
    time.sleep(600)


RUN = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_workers import OPTIONS, run_jobs, say_nothing
run_jobs(say_nothing, ["a", "b"], workers=2, **OPTIONS)
"""


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_workers_end_with_a_parent_that_was_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert [parent.stdout.readline() for _ in "ab"] == [b"started\n"] * 2
        parent.kill()
        assert parent.stdout.read() == b""  # returns when no worker holds the pipe


def sleep(job: int, report: Report) -> None:
    report(1)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    report(1)
    time.sleep(600)


@pytest.mark.slow
def test_a_worker_that_does_not_stop_in_time_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "GRACE", 1.0)
    reported: list[int] = []

    def update(bar: Any, units: int) -> None:
        reported.append(units)
        if len(reported) == 4:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(workers, "progress", type("Bar", (Lines,), {"update": update}))
    with stop_on_signals(), pytest.raises(StoppedError):
        run_jobs(sleep, [1, 2], workers=2, **OPTIONS)
    assert not multiprocessing.active_children()


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_second_signal_kills_workers_that_do_not_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "GRACE", 3600.0)
    reported: list[int] = []

    def update(bar: Any, units: int) -> None:
        reported.append(units)
        if len(reported) == 4:
            signal.raise_signal(signal.SIGTERM)
            threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGTERM)).start()

    monkeypatch.setattr(workers, "progress", type("Bar", (Lines,), {"update": update}))
    with stop_on_signals(), pytest.raises(KeyboardInterrupt):
        run_jobs(sleep, [1, 2], workers=2, **OPTIONS)
    assert not multiprocessing.active_children()


LOG = logging.getLogger("torchrl_bmrl.test_workers")


def talk(job: str, report: Report) -> str:
    """Messages of every level, before and after a report; the last argument exists here only."""
    for number in range(20):
        LOG.debug("%s %d", job, number)
        LOG.info("%s %d", job, number)
        report(0)
        LOG.warning("%s %d of %s", job, number, threading.current_thread())
    return job


@pytest.mark.slow
@pytest.mark.parametrize("level", [logging.DEBUG, logging.INFO, logging.WARNING])
def test_what_workers_log_reaches_the_handlers_of_this_process_once_and_in_order(
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    level: int,
) -> None:
    monkeypatch.setattr("torchrl_bmrl.run.progress.SOON", 3600.0)  # a busy machine starts slowly
    caplog.set_level(level, "torchrl_bmrl")
    assert run_jobs(talk, ["a", "b", "c"], workers=2, **OPTIONS) == ["a", "b", "c"]
    levels = [x for x in (logging.DEBUG, logging.INFO, logging.WARNING) if x >= level]
    for job in "abc":
        mine = [record for record in caplog.records if record.getMessage().startswith(job)]
        assert [record.levelno for record in mine] == levels * 20
        numbers = [int(record.getMessage().split()[1]) for record in mine]
        assert numbers == sorted([*range(20)] * len(levels))
        assert {record.name for record in mine} == {LOG.name}
    assert {record.process for record in caplog.records}.isdisjoint({os.getpid()})
    assert capfd.readouterr().err == ""


def test_without_processes_messages_reach_the_same_handlers(
    caplog: pytest.LogCaptureFixture,
) -> None:
    run_jobs(talk, ["a"], workers=1, **OPTIONS)
    assert [message.split()[:2] for message in caplog.messages] == [
        ["a", str(i)] for i in range(20)
    ]


@pytest.mark.parametrize(
    "error",
    [
        BMRLError("a message"),
        CheckpointError("runs/lift", "no manifest"),
        ConfigError("a message"),
        DataError("lift.hdf5", "data", "missing"),
        UnknownNameError("task", "lft", ["reach", "lift"]),
    ],
)
def test_errors_survive_the_way_from_a_worker(error: BMRLError) -> None:
    arrived = pickle.loads(pickle.dumps(error))
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    assert vars(arrived) == vars(error)


@pytest.mark.parametrize(("workers", "jobs"), [(1, [3, 1, 2]), (4, [3]), (2, [])])
def test_without_need_for_processes_everything_runs_here(workers: int, jobs: list[int]) -> None:
    before, reports = torch.get_num_threads(), []

    def here(job: int, report: Report) -> tuple[int, int, int]:
        report(1)
        reports.append(job)
        return 10 * job, os.getpid(), torch.get_num_threads()

    torch.set_num_threads(2)
    try:
        results = run_jobs(here, jobs, workers=workers, **OPTIONS)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert results == [(10 * job, os.getpid(), 1) for job in jobs]
    assert reports == jobs


def test_threads_are_restored_after_a_job_that_fails() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(CheckpointError):
            run_jobs(fail, ["lift"], workers=1, **OPTIONS)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_seeds_differ_by_purpose_and_stay_the_same() -> None:
    names = [(0, "bcq", "lift"), (1, "bcq", "lift"), (0, "bcq", "reach"), (0, "bcq"), (0, "b", 3)]
    seeds = [derive_seed(*name) for name in names]
    assert len(set(seeds)) == len(names)
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert seeds == [derive_seed(*name) for name in names]
