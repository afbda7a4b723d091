"""Damaged files of a run are named, and training continues from the checkpoint before."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

import h5py
from small_runs import STAGES, Run, contents, exit_code, tasks

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]


@pytest.mark.parametrize("folder", ["bcq/lift", "distill"])
def test_a_run_goes_on_from_the_checkpoint_before_a_damaged_one(
    run: Run, finished: Path, finished_copy: Path, folder: str, capfd: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    path = f"{folder}/checkpoint.safetensors"
    data = bytearray((finished_copy / path).read_bytes())
    data[len(data) // 2] ^= 4
    (finished_copy / path).write_bytes(data)
    run(finished_copy, two_stage)
    said = capfd.readouterr().err
    assert f"{path}: not a complete safetensors checkpoint" in said
    assert "the checksum differs" in said
    assert "training continues from checkpoint.1.safetensors" in said
    (finished_copy / path).with_name("checkpoint.damaged.safetensors").unlink()
    assert contents(finished_copy, *STAGES) == contents(finished, *STAGES)


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
    run: Run, finished_copy: Path, path: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage2, two_stage

    (finished_copy / path).write_text(text)
    shutil.rmtree(finished_copy / "distill")  # so that something is left to do
    # Collecting would write the statistics again.
    stage = stage2 if path.startswith("data") else two_stage
    assert exit_code(run, finished_copy, stage) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: ")
    assert path in said or path == "config.yaml"
    assert str(finished_copy) in said


@pytest.mark.parametrize("damage", ["truncated", "not finite"])
def test_damaged_demonstrations_stop_training_before_anything_is_written(
    run: Run,
    collected_run: Path,
    capsys: pytest.CaptureFixture[str],
    damage: str,
) -> None:
    from torchrl_bmrl.pipeline import stage1

    path = collected_run / "data" / "lift.hdf5"
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:-1000])
    else:
        with h5py.File(path, "r+") as file:
            file["data/demo_0/rewards"][2] = float("nan")
    with pytest.raises(SystemExit) as caught:
        run(collected_run, stage1, tasks("lift"))
    assert caught.value.code == 1
    message = capsys.readouterr().err.splitlines()[-1]
    says = "not a complete HDF5 file" if damage == "truncated" else "not finite in row 2"
    assert message.startswith(f"error: {path}: ")
    assert says in message
    assert not (collected_run / "bcq").exists()
