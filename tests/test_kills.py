"""Whole runs killed at random moments, and started again.

Every second one is not killed but asked to stop, with a signal to all of its processes, as
schedulers and closed terminals do. One of each with the smallest run; with ``BMRL_KILLS=50`` in the
environment fifty with preset smoke, which take more than an hour.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import RECIPES, SMALL, contents

from torchrl_bmrl.data.robomimic import open_episodes, read_kept_episode
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.training.checkpoint import load_checkpoint

pytestmark = [
    pytest.mark.robosuite,
    pytest.mark.slow,
    pytest.mark.timeout(0),
    pytest.mark.usefixtures("signals_not_ignored"),  # a run inherits which ones are
]
KILLS = int(os.environ.get("BMRL_KILLS", "0"))
ASKED = (signal.SIGTERM, signal.SIGHUP)
EQUAL = (
    "results.csv",
    "tables/*",
    "data/*.hdf5",
    "data/statistics.json",
    "**/best.safetensors",
    "**/checkpoint.safetensors",
    "bcq/*/evaluations.csv",
    "evaluation/*.csv",
    "logs/*/scalars/*",
)
"""What a run that was killed has in common with one that was not: all but times.

The checkpoint before the newest is another one if the run was asked to stop just after it.
"""


def start(folder: Path) -> subprocess.Popen[bytes]:
    settings = [*(["preset=smoke"] if KILLS else SMALL), "workers=2", f"run_dir={folder}"]
    command = [sys.executable, str(RECIPES / "two_stage.py"), *settings]
    with (folder.parent / f"{folder.name}.log").open("ab") as log:
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, cwd=folder.parent, start_new_session=True
        )


def read_log(folder: Path) -> str:
    return (folder.parent / f"{folder.name}.log").read_text()


def finish(folder: Path) -> float:
    """Runs to the end; how long it took [s]."""
    began = time.monotonic()
    process = start(folder)
    process.communicate()
    assert process.returncode == 0, read_log(folder)[-3000:]
    return time.monotonic() - began


def ask_to_stop(process: subprocess.Popen[bytes], folder: Path, number: signal.Signals) -> None:
    """Signals all processes; the run saves every update that it has logged."""
    os.killpg(process.pid, number)
    code = process.wait(300)
    assert code in (128 + number, -number), read_log(folder)[-3000:]  # -number: before it began
    assert "Traceback" not in read_log(folder)
    for rows in folder.glob("logs/*/scalars/*.csv"):
        stage = rows.parts[-3].replace("bcq_", "bcq/")
        kind = "bcq" if stage.startswith("bcq/") else "student"
        last = int(rows.read_text().splitlines()[-1].split(",")[0])
        metadata = load_checkpoint(folder / stage / "checkpoint.safetensors", kind=kind)[1]
        assert metadata["updates"] >= last, rows


def read_everything(folder: Path) -> dict[str, bytes]:
    """Reads every finished file; the episodes and checkpoints among them."""
    for path in folder.glob("data/.episodes/*/*.npz"):
        read_kept_episode(path)
    for path in folder.glob("data/*.hdf5"):
        with open_episodes(path) as episodes:
            assert len(episodes) == (3 if KILLS else 2)
    for path in folder.glob("**/*.safetensors"):
        kind = "student" if path.parent.name == "distill" else "bcq"
        load_checkpoint(path, kind=kind)
    for path in folder.glob("evaluation/*.csv"):
        read_results(path)
    return contents(folder, "data/.episodes/*/*.npz", "data/*.hdf5", "evaluation/*.csv")


def test_killed_at_any_moment_a_run_has_lost_nothing_and_ends_with_the_same_files(
    request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    if KILLS:
        whole = tmp_path / "whole"
        seconds = finish(whole)
    else:  # one worker's; where two are done before the moment, it is drawn again
        whole, seconds = request.getfixturevalue("finished"), 20.0
    expected = contents(whole, *EQUAL)
    assert len(expected) > 40
    moments, killed = random.Random(0), 0
    while killed < (KILLS or 2):
        folder = tmp_path / f"killed-{killed}"
        process, moment, began = start(folder), moments.uniform(0.0, seconds), time.monotonic()
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            if killed % 2:
                ask_to_stop(process, folder, ASKED[killed // 2 % 2])
            else:
                process.kill()
                process.wait()
        else:  # faster than the first one
            seconds = time.monotonic() - began
            shutil.rmtree(folder)
            continue
        killed += 1
        process.communicate(timeout=300)  # the output ends with the last process of the run
        kept = read_everything(folder)
        print(f"{killed}: {moment:.1f} of {seconds:.1f} s, {len(kept)} files kept", flush=True)
        finish(folder)
        assert contents(folder, *EQUAL) == expected, f"killed after {moment:.1f} s"
        now = contents(folder, "data/*.hdf5", "evaluation/*.csv")
        assert all(now[name] == kept[name] for name in kept if name in now)
        shutil.rmtree(folder)
