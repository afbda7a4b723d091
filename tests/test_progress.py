"""How far a loop is: lines where there is no terminal, at least one a minute, each whole."""

from __future__ import annotations

import io
import logging
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("tqdm")

from tqdm import tqdm

from torchrl_bmrl.run import progress as module
from torchrl_bmrl.run.logs import write_line
from torchrl_bmrl.run.progress import Lines, progress
from torchrl_bmrl.run.workers import Report

OPTIONS: dict[str, Any] = {"total": 400, "description": "stage 1: training", "unit": "update"}
LINE = re.compile(
    r"stage 1: training: \d+ of 400 updates \(\d+%\), "
    r"([\d.,e+]+ updates/(s|min|h), \d+:\d\d:\d\d left|none in the last \d+:\d\d:\d\d"
    r"|done in \d+:\d\d:\d\d)"
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_line_has_what_is_done_the_rate_of_late_and_the_time_left() -> None:
    lines = Lines(30_000, "stage 1: training", "update")
    start = lines.started
    lines.update(10_000)  # read back at once
    said = []
    for minute in range(1, 9):
        lines.update(60)
        said.append(lines.line(start + 60 * minute))
    assert said[0].startswith("stage 1: training: 10,060 of 30,000 updates (34%), ")
    # What was read back is forgotten; (30000 - 10480) / 1 per second.
    assert said[-1] == (
        "stage 1: training: 10,480 of 30,000 updates (35%), 1 updates/s, 5:25:20 left"
    )


@pytest.mark.parametrize(
    ("done", "says"),
    [
        (7200, "7,200 of 10,000 episodes (72%), 2 episodes/s, 0:23:20 left"),
        (60, "60 of 10,000 episodes (1%), 1 episodes/min, 165:40:00 left"),
        (2, "2 of 10,000 episodes (0%), 2 episodes/h, 4999:00:00 left"),
        (0, "0 of 10,000 episodes (0%), none in the last 1:00:00"),
        (-3, "-3 of 10,000 episodes (-0%), none in the last 1:00:00"),
        (9_000_000, "9,000,000 of 10,000 episodes (90000%), 2,500 episodes/s, 0:00:00 left"),
        (10_001, "10,001 of 10,000 episodes (100%), 2.78 episodes/s, 0:00:00 left"),
    ],
)
def test_slow_loops_and_none_at_all_have_a_rate_that_one_can_read(done: int, says: str) -> None:
    lines = Lines(10_000, "collecting", "episode")
    lines.update(done)
    assert lines.line(lines.started + 3600) == f"collecting: {says}"


@pytest.mark.parametrize("started", [0.0, 4095.9, 30_000.3, 131_071.7])
@pytest.mark.parametrize("seconds", [1, 60, 3600])
def test_the_age_of_the_clock_does_not_change_the_unit_of_a_rate(
    seconds: int, started: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A machine's clock counts from its start; the difference of two of its times is not exact.
    with monkeypatch.context() as patched:
        patched.setattr(module, "time", SimpleNamespace(monotonic=lambda: started))
        lines = Lines(None, "converting", "episode")
    unit = {1: "s", 60: "min", 3600: "h"}[seconds]
    for number in range(1, 200):
        lines.update(1)
        said = lines.line(started + seconds * number)
        assert said == f"converting: {number} episodes, 1 episodes/{unit}"


def test_without_a_total_the_rate_alone_is_said() -> None:
    lines = Lines(None, "converting", "episode")
    lines.update(90)
    assert lines.line(lines.started + 60) == "converting: 90 episodes, 1.5 episodes/s"


def test_a_line_comes_though_the_loop_reports_nothing_and_none_when_it_was_short(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with progress(**OPTIONS) as bar:
        bar.update(400)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(module, "SOON", 0.02)
    monkeypatch.setattr(module, "INTERVAL", 0.05)
    with progress(**OPTIONS):
        time.sleep(0.5)
    said = capsys.readouterr().err.splitlines()
    assert len(said) >= 5
    assert all(LINE.fullmatch(line) for line in said)
    assert "0 of 400 updates (0%), done in 0:00:0" in said[-1]
    time.sleep(0.1)
    assert capsys.readouterr().err == ""  # nothing comes after the end


def test_the_first_line_comes_soon_and_no_minute_is_without_one() -> None:
    assert module.SOON <= 10
    assert module.INTERVAL < 60


def test_a_loop_that_fails_is_not_said_to_be_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "SOON", 0.01)

    def fail() -> None:
        with progress(**OPTIONS):
            time.sleep(0.1)
            raise KeyError("lift")

    with pytest.raises(KeyError):
        fail()
    said = capsys.readouterr().err
    assert "none in the last" in said
    assert "done" not in said


def test_a_terminal_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", screen := Terminal())
    with progress(**OPTIONS, mininterval=0) as bar:
        assert isinstance(bar, tqdm)
        bar.update(100)
    assert "stage 1: training:  25%" in screen.getvalue()
    assert "100/400" in screen.getvalue()


def test_messages_and_lines_of_threads_stay_whole(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "SOON", 1e-4)
    monkeypatch.setattr(module, "INTERVAL", 1e-4)

    def talk(name: str) -> None:
        for _ in range(200):
            write_line(name * 40)

    threads = [threading.Thread(target=talk, args=(name,)) for name in "abc"]
    with progress(**OPTIONS):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    said = capfd.readouterr().err.splitlines()
    for name in "abc":
        assert said.count(name * 40) == 200
    assert all(line[1:] == line[:-1] or LINE.fullmatch(line) for line in said)


def test_a_log_that_nobody_takes_ends_no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Closed())
    monkeypatch.setattr(module, "SOON", 0.01)
    with progress(**OPTIONS):
        time.sleep(0.1)
    write_line("nobody hears it")


def talk_and_work(name: str, report: Report) -> None:
    for number in range(100):
        logging.getLogger("torchrl_bmrl.test").info(f"{name} {number:03} " + name * 60)
        time.sleep(0.01)
        report(1)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 3])
def test_a_pipe_gets_whole_lines_from_all_workers(workers: int, tmp_path: Path) -> None:
    script = f"""
from test_progress import OPTIONS, module, talk_and_work
from torchrl_bmrl.run.logs import log_to_stderr
from torchrl_bmrl.run.workers import run_jobs
if __name__ == "__main__":
    log_to_stderr()
    module.SOON, module.INTERVAL = 0.1, 0.02
    run_jobs(talk_and_work, list("abcd"), workers={workers}, **OPTIONS)
"""
    (tmp_path / "script.py").write_text(script)
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
        check=True,
    )
    said = done.stdout.splitlines()
    expected = [f"{name} {number:03} {name * 60}" for name in "abcd" for number in range(100)]
    lines = [line for line in said if LINE.fullmatch(line)]
    assert sorted(set(said) - set(lines)) == sorted(expected)
    assert len(said) == len(expected) + len(lines)
    assert len(lines) > 10
    assert re.fullmatch(r"stage 1: training: 400 of 400 updates \(100%\), done in .*", lines[-1])


@pytest.mark.robosuite
@pytest.mark.slow
def test_every_stage_of_a_run_says_how_far_it_is_in_a_batch_systems_log(tmp_path: Path) -> None:
    pytest.importorskip("hydra")
    pytest.importorskip("robosuite", exc_type=ImportError)
    from small_runs import SMALL, recipe

    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(
        "import torchrl_bmrl.run.progress as module\nmodule.SOON, module.INTERVAL = 0.01, 0.02\n"
    )
    search = [str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")]
    path = os.pathsep.join(filter(None, search))
    done = recipe("two_stage", *SMALL, "run_dir=run", "workers=2", cwd=tmp_path, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    said = done.stderr.splitlines()
    for stage, total in {
        "collecting demonstrations": "4 episodes",
        "stage 1: training BCQ": "24 updates",
        "stage 2: distilling": "12 updates",
        "evaluating": "100 steps",
    }.items():
        mine = [line for line in said if line.startswith(f"{stage}: ")]
        assert len(mine) > 1
        assert all(re.search(r", (done in|none in the last) |, .*/.* left$", x) for x in mine)
        assert re.search(rf" of {total} \(100%\), done in 0:0\d:\d\d$", mine[-1])
