"""Weights & Biases: a run's losses lie in runs of their own, read back from its offline files."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("tqdm")
pytest.importorskip("wandb")

from small_runs import Interruption, Run, make_run
from wandb_files import offline, read_runs


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize("stacked", [False, True])
def test_each_task_and_stage_logs_to_its_own_wandb_run_and_goes_on_in_it(
    run: Run, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stacked: bool
) -> None:
    from torchrl_bmrl.pipeline import stage1, stage2
    from torchrl_bmrl.pipeline.stage1 import train_job

    offline(monkeypatch, tmp_path / "home")
    folder, csv = tmp_path / "run", tmp_path / "csv"
    options = ["logger=csv", f"bcq.stacked={str(stacked).lower()}"]
    for copy in (folder, csv):
        shutil.copytree(finished / "data", copy / "data")
    for stage in (stage1, stage2):
        run(csv, stage, *options)
    options[0] = "logger=wandb"
    made = make_run(folder, *options)
    agents = {"reach": "reach", "lift": "lift"}
    for job in [agents] if stacked else [{name: name} for name in agents]:
        with pytest.raises(KeyboardInterrupt):  # after a checkpoint at 4, a row at 4
            train_job((made, job), Interruption(7 * len(job), KeyboardInterrupt))
    first = read_runs(folder)
    time.sleep(1.1)  # wandb's folders have the second of their start in their names
    run(folder, stage1, *options)
    run(folder, stage2, *options)

    found = read_runs(folder)
    assert [run["name"] for run in first] == ["bcq_reach", "bcq_lift"]
    assert [run["name"] for run in found[2:]] == ["bcq_reach", "bcq_lift", "distill"]
    assert len({run["id"] for run in found}) == 3
    assert all(run["ended"] for run in found)
    for name in ("bcq_reach", "bcq_lift", "distill"):
        mine = [run for run in found if run["name"] == name]
        assert len({run["id"] for run in mine}) == 1
        rows = [row for run in mine for row in run["rows"] if "loss_generator" in row]
        assert [row["step"] for row in rows] == [4, 8, 12]
        logged = csv / "logs" / name / "scalars" / "loss_generator.csv"
        expected = [float(line.partition(",")[2]) for line in logged.read_text().splitlines()]
        assert [row["loss_generator"] for row in rows] == pytest.approx(expected, rel=1e-4)
