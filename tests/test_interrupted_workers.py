"""Workers whose parent is suspended, reads late, or is stopped while they start."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("tqdm")

from test_workers import OPTIONS, Lines, signal_when_all_work, work_until_stopped

from torchrl_bmrl.errors import StoppedError
from torchrl_bmrl.run import workers
from torchrl_bmrl.run.stops import stop_on_signals
from torchrl_bmrl.run.workers import Report, run_jobs


class Pauses:
    """The module ``time`` for a process that sleeps for hours in each wait for its workers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.slept = 0.0
        monkeypatch.setattr(workers, "time", self)
        wait = workers.wait
        monkeypatch.setattr(workers, "wait", lambda *args, **kw: self.sleep() or wait(*args, **kw))

    def sleep(self) -> None:
        self.slept += 10 * workers.SILENCE

    def monotonic(self) -> float:
        return time.monotonic() + self.slept


def report_slowly(job: tuple[str, Path], report: Report) -> str:
    """Three reports; the first try leaves its name behind."""
    name, folder = job
    (folder / name).open("x").close()
    for _ in range(3):
        time.sleep(0.1)
        report(1)
    return name


@pytest.mark.slow
def test_silence_while_this_process_was_suspended_kills_no_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    Pauses(monkeypatch)
    jobs = [(name, tmp_path) for name in "abc"]
    assert run_jobs(report_slowly, jobs, workers=2, **OPTIONS) == ["a", "b", "c"]
    assert not caplog.messages


@pytest.mark.slow
@pytest.mark.usefixtures("signals_not_ignored")
def test_suspended_while_it_stops_a_run_keeps_what_its_jobs_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Pauses(monkeypatch)
    with stop_on_signals():
        thread = signal_when_all_work(tmp_path, "ab", signal.SIGTERM, group=True)
        with pytest.raises(StoppedError):
            run_jobs(work_until_stopped, [(x, tmp_path) for x in "ab"], workers=2, **OPTIONS)
    thread.join()
    assert all(int((tmp_path / name).read_text()) >= 1 for name in "ab")


def report_often(job: tuple[str, Path], report: Report) -> None:
    """More reports than a connection holds."""
    name, folder = job
    try:
        while True:
            report(1)
    except StoppedError:
        (folder / name).touch()
        raise


@pytest.mark.slow
@pytest.mark.usefixtures("signals_not_ignored")
def test_asked_to_stop_jobs_save_also_if_nobody_has_read_their_last_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "GRACE", 10.0)
    seen: list[int] = []

    def update(bar: Any, units: int) -> None:
        seen.append(units)
        if len(seen) == 1000:
            time.sleep(0.5)  # the connections fill up
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(workers, "progress", type("Bar", (Lines,), {"update": update}))
    with stop_on_signals(), pytest.raises(StoppedError):
        run_jobs(report_often, [(x, tmp_path) for x in "ab"], workers=2, **OPTIONS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


@pytest.mark.slow
@pytest.mark.usefixtures("signals_not_ignored")
def test_stopped_while_workers_start_that_import_for_themselves_no_traceback_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(workers, "METHOD", "spawn")  # as on macOS

    def interrupt() -> None:
        while len(children := multiprocessing.active_children()) < 2:
            time.sleep(0.01)
        time.sleep(2.0)  # they import
        for pid in (*(child.pid for child in children), os.getpid()):
            os.kill(pid or 0, signal.SIGINT)

    with stop_on_signals():
        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(StoppedError):
            run_jobs(report_often, [(x, tmp_path) for x in "ab"], workers=2, **OPTIONS)
    thread.join()
    assert "Traceback" not in capfd.readouterr().err
