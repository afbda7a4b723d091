"""Runs that are stopped, disturbed, or go wrong: what is said, what is kept, how they go on."""

from __future__ import annotations

import os
import re
import shutil
import signal
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

from small_runs import Run, contents, tasks, times

from torchrl_bmrl.run import workers
from torchrl_bmrl.run.locks import lock
from torchrl_bmrl.run.progress import Lines
from torchrl_bmrl.training.checkpoint import load_checkpoint

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]
STAGES = ("bcq/*/*", "distill/*", "results.csv", "tables/*", "logs/*/scalars/*")


def ends(run: Run, folder: Path, function: Any, *overrides: str) -> int:
    """Exit code of a recipe that does not end well."""
    with pytest.raises(SystemExit) as end:
        run(folder, function, *overrides)
    return int(end.value.code)  # type: ignore[arg-type]


@pytest.fixture
def collected(finished: Path, tmp_path: Path) -> Path:
    """A run folder with demonstrations alone."""
    shutil.copytree(finished / "data", tmp_path / "run" / "data")
    return tmp_path / "run"


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A finished run."""
    return shutil.copytree(finished, tmp_path / "run")


# -- asked to stop ---------------------------------------------------------------------------------


def signal_after(patch: pytest.MonkeyPatch, units: int) -> None:
    """Sends this process SIGTERM when so many units of a job are done."""

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
        # Agents report 12 updates each: the second one is at its seventh.
        ("train_bcq", 19, "bcq/lift/checkpoint.safetensors", 7),
        ("distill", 7, "distill/checkpoint.safetensors", 7),
        ("evaluate", 60, "evaluation/*.csv", None),  # some
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
        assert ends(run, tmp_path / "run", two_stage) == 143
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
    # But for the checkpoint before the newest: there is one more of them.
    both = [contents(folder, *STAGES) for folder in (finished, tmp_path / "run")]
    differing = {name for name in both[0] if both[0][name] != both[1].get(name)}
    assert differing <= {"bcq/lift/checkpoint.1.safetensors", "distill/checkpoint.1.safetensors"}
    assert both[0].keys() == both[1].keys()
    assert len(both[0]) > 30


# -- one run at a time -----------------------------------------------------------------------------


def test_a_second_run_in_a_folder_is_refused_by_the_owner_and_writes_nothing(
    run: Run, copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    before = contents(copied, "**/*")
    with lock(copied):
        assert ends(run, copied, two_stage) == 1
        assert f"error: {copied}: in use by process {os.getpid()} on " in capsys.readouterr().err
        after = contents(copied, "**/*")
    new = {name for name in after if name not in before}
    assert all(name.startswith(".locks") for name in new)
    assert {name: after[name] for name in before} == before
    run(copied, two_stage)


def test_jobs_of_other_tasks_share_a_folder_and_the_same_task_is_refused(
    run: Run, collected: Path, recipes: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    from small_runs import SMALL, configured

    from torchrl_bmrl.pipeline import stage1

    def train(task: str) -> None:
        settings = configured(*SMALL, f"run_dir={collected}", "workers=1", f"only=[{task}]")
        recipes.run_recipe(settings, stage1, splits=True)

    with lock(collected, ["lift"]):
        train("reach")
        with pytest.raises(SystemExit):
            train("lift")
        assert "in use by" in capsys.readouterr().err
        # The whole run would train it, too.
        assert ends(run, collected, stage1) == 1
    assert not (collected / "bcq" / "lift").exists()


# -- damaged files ---------------------------------------------------------------------------------


@pytest.mark.parametrize("folder", ["bcq/lift", "distill"])
def test_a_run_goes_on_from_the_checkpoint_before_a_damaged_one(
    run: Run, finished: Path, copied: Path, folder: str, capfd: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    path = f"{folder}/checkpoint.safetensors"
    data = bytearray((copied / path).read_bytes())
    data[len(data) // 2] ^= 4
    (copied / path).write_bytes(data)
    run(copied, two_stage)
    said = capfd.readouterr().err
    assert f"{path}: not a complete safetensors checkpoint" in said
    assert "the checksum differs" in said
    assert "training continues from checkpoint.1.safetensors" in said
    (copied / path).with_name("checkpoint.damaged.safetensors").unlink()
    everything = ("bcq/*/*", "distill/*", "results.csv", "tables/*", "logs/*/scalars/*")
    assert contents(copied, *everything) == contents(finished, *everything)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("data/statistics.json", '{"loc": [1], "scale": [0]}'),
        ("data/statistics.json", "[" * 100_000),
        ("evaluation/lift-bcq.csv", "task,policy\n"),
        ("evaluation/lift-bcq.csv", "\0\0\n"),
        ("versions.json", "[1]"),
        ("seconds.json", "{"),
        ("config.yaml", "a: &a [*a]"),
        ("config.yaml", "seed: 0"),
    ],
)
def test_a_damaged_file_of_a_run_is_named_in_one_line(
    run: Run, copied: Path, path: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage2, two_stage

    (copied / path).write_text(text)
    shutil.rmtree(copied / "distill")  # something is left to do
    # What is cheap to make is made again: collecting would mend the statistics.
    stage = stage2 if path.startswith("data") else two_stage
    assert ends(run, copied, stage) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: ")
    assert path in said or path == "config.yaml"
    assert str(copied) in said


# -- the machine -----------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="no /proc")
def test_a_folder_that_cannot_be_written_is_named_in_one_line(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    (tmp_path / "file").touch()
    for folder, why in ((tmp_path / "file" / "run", "Not a directory"), (Path("/proc/run"), "")):
        assert ends(run, folder, two_stage) == 1
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
        assert ends(run, folder, two_stage) == 1
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
    run: Run, collected: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import learners, stage1

    def full(*arguments: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nDetails.")

    monkeypatch.setattr(learners, "gradient_step", full)
    assert ends(run, collected, stage1) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(
        "error: CUDA out of memory. Tried to allocate 2.00 GiB.; lower bcq.batch"
    )


def test_a_run_whose_logger_fails_goes_on_and_says_so_once(
    run: Run,
    finished: Path,
    collected: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl.record.loggers.csv import CSVLogger

    from torchrl_bmrl.pipeline import stage1

    def unreachable(*arguments: Any, **options: Any) -> None:
        raise ConnectionError("server not reached")

    monkeypatch.setattr(CSVLogger, "log_scalar", unreachable)
    run(collected, stage1, tasks("reach", "lift"))
    said = capsys.readouterr().err
    assert said.count("metrics from step 4 on are not logged (server not reached)") == 2
    assert contents(collected, "bcq/*/*") == contents(finished, "bcq/*/*")


# -- numbers that go wrong -------------------------------------------------------------------------


def broken(name: str, update: int) -> Any:
    """Breaks a loss in a way, before the update is looked at."""

    def change(kept: Any) -> None:
        decoder = kept.loss.generator_params["decoder", "module", "network"]
        critic = kept.loss.qvalue_network_params["module"]
        with torch.no_grad():
            if name == "nan":
                critic["0", "weight"].fill_(float("nan"))
            elif name == "exploding":
                critic["4", "bias"].fill_(5e3)
            elif name == "dead":
                for key in ("0", "2", "4"):
                    decoder[key, "weight"].zero_()
            else:
                decoder["4", "bias"].fill_(50.0)

    return change


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("nan", r"loss_qvalue is nan"),
        ("exploding", r"pred_value is .*, above .*; the training has diverged"),
        ("dead", r"all candidates of a state are equal"),
        ("saturated", r"100% of the proposed action components lie at a bound"),
    ],
)
@pytest.mark.parametrize("stacked", [False, True])
def test_what_goes_wrong_is_named_within_one_logging_interval_and_the_good_checkpoint_kept(
    run: Run,
    finished: Path,
    collected: Path,
    what: str,
    says: str,
    stacked: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import learners, stage1

    step, calls = learners.gradient_step, []
    agents: list[Any] = []
    make = learners.Agents

    class Watched(make):  # type: ignore[misc, valid-type]
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            agents.append(self)

    def breaking(optimizer: Any, loss: Any, max_norm: Any) -> None:
        step(optimizer, loss, max_norm)
        calls.append(loss)  # the generator's and the critics' in turn
        if len(calls) == 2 * 5:  # after the fifth update, checkpoint and look are at the fourth
            broken(what, 5)(agents[-1])

    monkeypatch.setattr(sys.modules[stage1.__module__], "Agents", Watched)
    monkeypatch.setattr(learners, "gradient_step", breaking)
    overrides = ["bcq.stacked=true"] if stacked else [tasks("lift")]
    assert ends(run, collected, stage1, *overrides) == 1
    said = capsys.readouterr().err
    assert re.search(rf"error: bcq (reach|lift), update 8: {says}", said), said
    assert "checkpoint stays" in said
    path = collected / "bcq" / "lift" / "checkpoint.safetensors"
    state, metadata = load_checkpoint(path, kind="bcq")
    assert metadata["updates"] == 4
    assert all(value.isfinite().all() for value in state["module"].values())


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("nan", r"loss_\w+ is nan"),
        ("dead", r"all candidates of a state are equal"),
        ("saturated", r"100% of the proposed action components lie at a bound"),
    ],
)
def test_a_student_that_goes_wrong_is_named_within_one_logging_interval(
    run: Run,
    finished: Path,
    collected: Path,
    what: str,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.pipeline import stage2

    module: Any = sys.modules[stage2.__module__]  # the package's function hides its name
    shutil.copytree(finished / "bcq", collected / "bcq")
    step, calls, students = module.gradient_step, [], []
    make = module.Student

    def watched(**options: Any) -> Any:
        students.append(make(**options))
        return students[-1]

    def breaking(optimizer: Any, loss: Any) -> None:
        step(optimizer, loss)
        calls.append(loss)
        if len(calls) == 5:
            layers = students[0].generator.module.network
            with torch.no_grad():
                if what == "nan":
                    layers[0].weight.fill_(float("nan"))
                elif what == "dead":
                    for layer in (layers[0], layers[2], layers[4]):
                        layer.weight.zero_()
                else:
                    layers[4].bias.fill_(50.0)

    monkeypatch.setattr(module, "Student", watched)
    monkeypatch.setattr(module, "gradient_step", breaking)
    assert ends(run, collected, stage2) == 1
    said = capsys.readouterr().err
    assert re.search(rf"error: distillation, update 8: {says}", said), said
    path = collected / "distill" / "checkpoint.safetensors"
    assert load_checkpoint(path, kind="student")[1]["updates"] == 4


def test_looking_at_the_numbers_changes_none_of_them(
    run: Run, finished: Path, collected: Path
) -> None:
    from torchrl_bmrl.pipeline import stage1

    # Other intervals are other settings, but not other agents.
    run(collected, stage1, "log_interval=1")
    for task in ("reach", "lift"):
        states = [
            load_checkpoint(folder / "bcq" / task / "checkpoint.safetensors", kind="bcq")[0]
            for folder in (finished, collected)
        ]
        for key, value in states[0]["module"].items():
            assert torch.equal(value, states[1]["module"][key]), key
