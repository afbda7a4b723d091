"""Runs that are asked to stop, and how commands end."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_bmrl.errors import ConfigError, FolderInUseError, StoppedError
from torchrl_bmrl.run import stops
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.stops import beside, check_stop, stop_on_signals, wait_for

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


pytestmark = pytest.mark.usefixtures("signals_not_ignored")


def handlers() -> list[Any]:
    return [signal.getsignal(number) for number in SIGNALS]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_stops_at_the_next_point_and_not_before(number: signal.Signals) -> None:
    done = []
    with stop_on_signals():
        check_stop()
        signal.raise_signal(number)
        done.append("what goes on is finished")
        with pytest.raises(StoppedError, match=f"stopped by {number.name}; finished work is saved"):
            check_stop()
    assert done
    check_stop()  # it is over


def test_a_later_signal_interrupts_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops, "REPEATS", 0.0)
    with stop_on_signals():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("second", SIGNALS)
def test_signals_that_come_together_are_one_request(second: signal.Signals) -> None:
    with stop_on_signals():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(second)
        with pytest.raises(StoppedError, match="stopped by SIGTERM; finished work is saved"):
            check_stop()


def test_handlers_are_put_back_and_what_was_ignored_stays_ignored() -> None:
    before = handlers()
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not before[1]
    finally:
        signal.signal(signal.SIGHUP, previous)
    assert handlers() == before


def test_another_thread_leaves_signals_alone() -> None:
    before, seen = handlers(), []

    def work() -> None:
        with stop_on_signals():
            seen.append(handlers())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


# -- exit codes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (ConfigError("bcq.lr is -1; valid: above 0"), 1, "error: bcq.lr is -1; valid: above 0"),
        (
            FolderInUseError("runs/a", 12, "node3"),
            1,
            "error: runs/a: in use by process 12 on node3",
        ),
        (StoppedError(signal.SIGTERM), 143, "stopped by SIGTERM; finished work is saved"),
        (StoppedError(signal.SIGINT), 130, "stopped by SIGINT"),
        (KeyboardInterrupt(), 130, "interrupted; finished work is saved"),
        (
            OSError(28, "No space left on device", "runs/a/x"),
            1,
            "runs/a/x: No space left on device",
        ),
        (OSError("no such device"), 1, "error: no such device; finished work is saved"),
        (MemoryError(), 1, "error: out of memory; fewer workers need less"),
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nMore."),
            1,
            "error: CUDA out of memory. Tried to allocate 2 GiB.; lower bcq.batch_size; finished",
        ),
    ],
)
def test_what_may_be_expected_is_one_line_and_an_exit_code(
    error: BaseException, code: int, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end, exit_codes(out_of_memory="lower bcq.batch_size"):
        raise error
    assert end.value.code == code
    assert end.value.__cause__ is error
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("number", SIGNALS)
def test_a_command_that_saves_nothing_before_its_end_stops_at_once_and_says_so(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    done = []

    def work() -> None:
        try:
            signal.raise_signal(number)
            done.append("more")
        finally:
            signal.raise_signal(number)  # a repeat leaves the cleaning up alone
            done.append("cleaned up")

    with pytest.raises(SystemExit) as end, exit_codes(saves=False):
        work()
    assert done == ["cleaned up"]
    assert end.value.code == 128 + number
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("error", [OSError(28, "No space left on device", "a"), MemoryError()])
def test_a_command_that_saves_nothing_before_its_end_promises_nothing(
    error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit), exit_codes(saves=False):
        raise error
    assert "saved" not in capsys.readouterr().err


def test_a_signal_after_the_last_unit_of_work_is_an_exit_code_as_well() -> None:
    with pytest.raises(SystemExit) as end, exit_codes():
        signal.raise_signal(signal.SIGINT)
    assert end.value.code == 130


def test_an_interrupt_before_a_command_starts_is_one_line() -> None:
    script = "import torchrl_bmrl.run.as_command, signal; signal.raise_signal(signal.SIGINT)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == -signal.SIGINT
    assert done.stderr == "interrupted\n"


def test_a_mistake_of_the_program_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError), exit_codes():
        raise ZeroDivisionError
    with exit_codes():
        pass


@pytest.mark.parametrize(
    "error",
    [
        StoppedError(signal.SIGTERM),
        FolderInUseError("runs/a", 12, "node3"),
        torch.OutOfMemoryError("CUDA out of memory."),
        OSError(28, "No space left on device", "runs/a/x"),
    ],
)
def test_errors_come_whole_from_a_worker(error: Exception) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)


# -- a full disk, from the operating system --------------------------------------------------------

WRITING = """
import sys
from pathlib import Path
import torch
from torchrl_bmrl.training.checkpoint import save_checkpoint
from torchrl_bmrl.run.command_line import exit_codes
with exit_codes():
    for size in (10, 10**6):
        save_checkpoint(Path(sys.argv[1]), {"a": torch.zeros(size)}, {"kind": "a", "size": size})
"""


def limit_files() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (10**5, 10**5))


@pytest.mark.skipif(sys.platform == "win32", reason="no limits")
def test_a_write_that_the_system_refuses_is_one_line_and_the_old_file_stays(tmp_path: Path) -> None:
    pytest.importorskip("safetensors")
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    path = tmp_path / "checkpoint.safetensors"
    command = [sys.executable, "-c", WRITING, str(path)]
    limited: Callable[[], None] = limit_files
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limited)
    assert done.returncode == 1, done.stderr
    assert "error: " in done.stderr
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert load_checkpoint(path, kind="a")[1]["size"] == 10
    assert os.listdir(tmp_path) == [path.name]


def test_what_is_called_beside_gives_its_result_or_its_error() -> None:
    with beside(threading.current_thread) as thread:
        assert thread.result() is not threading.current_thread()
    with pytest.raises(ZeroDivisionError), beside(lambda: 1 / 0) as error:
        error.result()


def test_what_is_called_beside_ends_with_a_block_that_fails() -> None:
    def work() -> None:
        while True:
            time.sleep(0.01)

    threads = threading.active_count()
    with pytest.raises(StoppedError), beside(work):
        raise StoppedError(signal.SIGTERM)
    assert threading.active_count() == threads


def test_a_stop_does_not_wait_for_what_is_called_beside() -> None:
    def work() -> None:
        while True:
            time.sleep(0.01)

    with stop_on_signals():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(StoppedError), beside(work) as result:
            wait_for(result)


def test_a_stopped_process_ends_what_is_called_beside_and_says_one_line() -> None:
    script = (
        "import signal, time, torch\n"
        "from torchrl_bmrl.run.command_line import exit_codes\n"
        "from torchrl_bmrl.run.stops import beside, check_stop\n"
        "def work():\n"
        "    while True:\n"
        "        torch.randn(200, 300).softmax(-1)\n"
        "def evaluate():\n"
        "    with beside(work):\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "        check_stop()\n"
        "with exit_codes():\n"
        "    evaluate()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stderr.splitlines() == [str(StoppedError(signal.SIGTERM))]
