"""A folder in use, a full disk, a full GPU, a failing logger: one message, and work is kept."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import SMALL, STAGES, Run, configured, contents, exit_code, tasks, times

from torchrl_bmrl.run.locks import lock

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]


def test_a_second_run_in_a_folder_is_refused_by_the_owner_and_writes_nothing(
    run: Run, finished_copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    before = contents(finished_copy, "**/*")
    with lock(finished_copy):
        assert exit_code(run, finished_copy, two_stage) == 1
        said = capsys.readouterr().err
        assert f"error: {finished_copy}: in use by process {os.getpid()} on " in said
        after = contents(finished_copy, "**/*")
    new = {name for name in after if name not in before}
    assert all(name.startswith(".locks") for name in new)
    assert {name: after[name] for name in before} == before
    run(finished_copy, two_stage)


def test_jobs_of_other_tasks_share_a_folder_and_the_same_task_is_refused(
    run: Run, collected_run: Path, recipes: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage1

    def train(task: str) -> None:
        settings = configured(*SMALL, f"run_dir={collected_run}", "workers=1", f"only=[{task}]")
        recipes.run_recipe(settings, stage1, splits=True)

    with lock(collected_run, ["lift"]):
        train("reach")
        with pytest.raises(SystemExit):
            train("lift")
        assert "in use by" in capsys.readouterr().err
        # The whole run would train lift too.
        assert exit_code(run, collected_run, stage1) == 1
    assert not (collected_run / "bcq" / "lift").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no /proc")
def test_a_folder_that_cannot_be_written_is_named_in_one_line(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    (tmp_path / "file").touch()
    for folder, why in ((tmp_path / "file" / "run", "Not a directory"), (Path("/proc/run"), "")):
        assert exit_code(run, folder, two_stage) == 1
        (said,) = capsys.readouterr().err.splitlines()
        assert said.startswith(f"error: {folder}")
        assert why in said


@pytest.mark.parametrize("stage", ["train_bcq", "distill", "evaluate"])
def test_a_full_disk_is_named_in_one_line_and_what_was_kept_stays(
    run: Run,
    finished: Path,
    tmp_path: Path,
    stage: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    folder = tmp_path / "run"
    shutil.copytree(finished / "data", folder / "data")
    place = {"train_bcq": "bcq", "distill": "distill", "evaluate": "evaluation"}[stage]
    fsync, written = os.fsync, []

    def full(descriptor: int) -> None:
        name = os.readlink(f"/proc/self/fd/{descriptor}") if sys.platform == "linux" else place
        written.append(name)
        if f"/{place}/" in name and len([name for name in written if f"/{place}/" in name]) > 1:
            raise OSError(28, "No space left on device", name)
        fsync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert exit_code(run, folder, two_stage) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"/{place}/" in said
    assert "No space left on device; finished work is saved, the same command continues it" in said
    assert not list(folder.rglob("*.tmp"))
    before = times(folder)
    run(folder, two_stage)
    unchanged = times(folder)
    assert all(unchanged[name] == before[name] for name in before if "/checkpoint" not in name)
    assert contents(folder, *STAGES) == contents(finished, *STAGES)


def test_a_gpu_without_memory_says_what_to_lower(
    run: Run,
    collected_run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import learners, stage1

    def full(*arguments: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nDetails.")

    monkeypatch.setattr(learners, "gradient_step", full)
    assert exit_code(run, collected_run, stage1) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(
        "error: CUDA out of memory. Tried to allocate 2.00 GiB.; lower bcq.batch"
    )


def test_a_run_whose_logger_fails_goes_on_and_says_so_once(
    run: Run,
    finished: Path,
    collected_run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl.record.loggers.csv import CSVLogger

    from torchrl_bmrl.pipeline import stage1

    def unreachable(*arguments: Any, **options: Any) -> None:
        raise ConnectionError("server not reached")

    monkeypatch.setattr(CSVLogger, "log_scalar", unreachable)
    run(collected_run, stage1, tasks("reach", "lift"))
    said = capsys.readouterr().err
    assert said.count("metrics from step 4 on are not logged (server not reached)") == 2
    assert contents(collected_run, "bcq/*/*") == contents(finished, "bcq/*/*")
