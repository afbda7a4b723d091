"""A run that was stopped continues to the same bytes as one that was never stopped."""

from __future__ import annotations

import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import STAGES, Interruption, Run, contents, exit_code, make_run

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.run import workers
from torchrl_bmrl.run.progress import Lines
from torchrl_bmrl.training.checkpoint import load_checkpoint

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]

LIFT = ("bcq/lift/*", "logs/bcq_lift/scalars/*")
"""Stage 1's files of lift: checkpoints (newest, the one before, best), rows of epochs, metrics."""


@pytest.mark.parametrize(
    ("update", "kept", "error"),
    # Checkpoints are due after updates 4, 8 and 12, evaluations after 6 and 12.
    [(3, None, KeyboardInterrupt), (7, 4, KeyboardInterrupt), (12, 12, BMRLError)],
)
def test_stage_1_resumed_equals_never_stopped(
    finished: Path, collected_run: Path, update: int, kept: int | None, error: Any
) -> None:
    from torchrl_bmrl.pipeline.stage1 import train_job

    made = make_run(collected_run)
    checkpoint = collected_run / "bcq" / "lift" / "checkpoint.safetensors"
    with pytest.raises(error):
        train_job((made, {"lift": "lift"}), Interruption(update, error))
    if kept is None:
        assert not checkpoint.exists()
    else:
        assert load_checkpoint(checkpoint, kind="bcq")[1]["updates"] == kept
    counted: list[int] = []
    train_job((made, {"lift": "lift"}), counted.append)
    # The checkpoint's updates are reported at once and are not trained again.
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    expected = contents(finished, *LIFT)
    assert len(expected) == 5 + 14
    assert contents(collected_run, *LIFT) == expected


@pytest.mark.parametrize("moment", ["write_rows", "save_best", "save"])
def test_stage_1_killed_between_two_files_goes_on_to_the_same_ones(
    finished: Path, collected_run: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.pipeline import learners
    from torchrl_bmrl.pipeline.stage1 import train_job

    made = make_run(collected_run)
    # The package's function stage1 hides the module of the same name.
    owner: Any = learners.Agents if "save" in moment else sys.modules[train_job.__module__]
    whole, calls = getattr(owner, moment), []

    def killed(*arguments: Any) -> None:
        calls.append(arguments)
        if len(calls) == 2:  # update 12 of the evaluations, update 8 of the checkpoints
            raise KeyboardInterrupt
        whole(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, moment, killed)
        with pytest.raises(KeyboardInterrupt):
            train_job((made, {"lift": "lift"}), lambda count: None)
    train_job((made, {"lift": "lift"}), lambda count: None)
    assert contents(collected_run, *LIFT) == contents(finished, *LIFT)


@pytest.mark.parametrize(("update", "kept"), [(3, None), (6, 4), (12, 12)])
def test_stage_2_resumed_equals_never_stopped(
    finished: Path, tmp_path: Path, update: int, kept: int | None
) -> None:
    from torchrl_bmrl.pipeline.stage2 import StudentJob, train_student

    for name in ("data", "bcq"):
        shutil.copytree(finished / name, tmp_path / name)
    made = make_run(tmp_path)
    checkpoint = tmp_path / "distill" / "checkpoint.safetensors"
    job = StudentJob(made.settings.distill, "distill")
    with pytest.raises(KeyboardInterrupt):
        train_student((made, job), Interruption(update, KeyboardInterrupt))
    if kept is None:
        assert not checkpoint.exists()
    else:
        assert load_checkpoint(checkpoint, kind="student")[1]["updates"] == kept
    counted: list[int] = []
    train_student((made, job), counted.append)
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    # The teachers' files are unchanged too.
    stages = ("bcq/*/*", "distill/*", "logs/distill/scalars/*")
    assert contents(tmp_path, *stages) == contents(finished, *stages)


def signal_after(patch: pytest.MonkeyPatch, units: int) -> None:
    """Sends this process SIGTERM once a job has reported this many units."""
    done = []

    def update(bar: Any, n: int) -> None:
        done.append(n)
        if sum(done) >= units > sum(done[:-1]):
            signal.raise_signal(signal.SIGTERM)

    patch.setattr(workers, "progress", type("Bar", (Lines,), {"update": update}))


@pytest.mark.parametrize(
    ("stage", "units", "files", "kept"),
    [
        ("collect", 2, "data/.episodes/*/*.npz", 2),
        # Each agent reports 12 updates: the second agent is at its seventh.
        ("train_bcq", 19, "bcq/lift/checkpoint.safetensors", 7),
        ("distill", 7, "distill/checkpoint.safetensors", 7),
        ("evaluate", 60, "evaluation/*.csv", None),  # some of the files
    ],
)
def test_asked_to_stop_a_stage_keeps_what_it_did_and_goes_on_to_the_same_result(
    run: Run,
    finished: Path,
    tmp_path: Path,
    stage: str,
    units: int,
    files: str,
    kept: int | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    with monkeypatch.context() as patch:
        run_jobs = workers.run_jobs
        at = {"collect": 0, "train_bcq": 1, "distill": 2, "evaluate": 3}[stage]
        calls = []

        def counting(*arguments: Any, **options: Any) -> Any:
            calls.append(arguments)
            if len(calls) == at + 1:
                signal_after(patch, units)
            return run_jobs(*arguments, **options)

        for module in ("torchrl_bmrl.experts.collect", "torchrl_bmrl.pipeline.run"):
            patch.setattr(f"{module}.run_jobs", counting)
        assert exit_code(run, tmp_path / "run", two_stage) == 143
    said = capsys.readouterr().err
    assert "stopped by SIGTERM; finished work is saved, the same command continues it" in said
    assert "Traceback" not in said
    found = sorted((tmp_path / "run").glob(files))
    if files.endswith("safetensors"):
        kind = {"train_bcq": "bcq", "distill": "student"}[stage]
        assert load_checkpoint(found[0], kind=kind)[1]["updates"] == kept
    elif kept is not None:
        assert len(found) == kept
    else:
        assert 0 < len(found) < len(contents(finished, files))
    run(tmp_path / "run", two_stage)
    # Stopping saves one more checkpoint, so the one before the newest may differ.
    both = [contents(folder, *STAGES) for folder in (finished, tmp_path / "run")]
    differing = {name for name in both[0] if both[0][name] != both[1].get(name)}
    assert differing <= {"bcq/lift/checkpoint.1.safetensors", "distill/checkpoint.1.safetensors"}
    assert both[0].keys() == both[1].keys()
    assert len(both[0]) > 30
