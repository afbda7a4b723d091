"""Jobs over processes: order, equality, what happens when one is killed."""

from __future__ import annotations

import os
import pickle
import signal
import time
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("tqdm")

from torchrl_bmrl import parallel
from torchrl_bmrl.errors import (
    BMRLError,
    CheckpointError,
    ConfigError,
    DataError,
    UnknownNameError,
)
from torchrl_bmrl.parallel import Report, derive_seed, run_jobs

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
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    updates: list[int] = []
    bar = type("Bar", (parallel.tqdm,), {"update": lambda bar, n: updates.append(n)})
    monkeypatch.setattr(parallel, "tqdm", bar)
    jobs = [(name, tmp_path, deaths) for name, deaths in zip("abcd", (0, 2, 0, 0), strict=True)]
    assert run_jobs(die_until, jobs, workers=2, **OPTIONS) == ["a", "b", "c", "d"]
    assert [len((tmp_path / name).read_text()) for name in "abcd"] == [1, 3, 1, 1]
    assert sum(updates) == 8
    assert updates.count(-1) == 2
    said = [line for line in capfd.readouterr().err.splitlines() if "killed" in line]
    assert len(said) == 2
    assert "a worker was killed by signal 9 (out of memory?) in job 2 of 4" in said[0]
    assert "done again" in said[1]


@pytest.mark.slow
def test_a_job_that_kills_its_worker_every_time_ends_the_run_with_a_message(
    tmp_path: Path,
) -> None:
    jobs = [("fine", tmp_path, 0), ("killed", tmp_path, 9)]
    with pytest.raises(BMRLError, match=r"stage 1: training: a worker was killed.* 3rd time"):
        run_jobs(die_until, jobs, workers=2, **OPTIONS)
    assert len((tmp_path / "killed").read_text()) == parallel.TRIES


def fail_unexpectedly(job: int, report: Report) -> None:
    raise ZeroDivisionError(f"job {job}")


@pytest.mark.slow
def test_an_unexpected_error_of_a_worker_comes_with_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError, match="job 1") as caught:
        run_jobs(fail_unexpectedly, [1, 1], workers=2, **OPTIONS)
    assert "in fail_unexpectedly" in str(caught.value.__cause__)


@pytest.mark.slow
def test_an_expected_error_of_a_worker_arrives_whole() -> None:
    with pytest.raises(CheckpointError, match="runs/lift"):
        run_jobs(fail, ["lift", "lift"], workers=2, **OPTIONS)


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
