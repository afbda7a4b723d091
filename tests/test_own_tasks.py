"""The page about a user's own tasks, executed as it is written, with fewer updates."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("hydra")
pytest.importorskip("h5py")
pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

from helpers import shown_files
from small_runs import RECIPES, recipe

from torchrl_bmrl.data.importing import read_original_bounds
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.pipeline.held_out import COLUMNS
from torchrl_bmrl.rows import read_rows

PAGE = RECIPES.parent / "docs" / "tasks.md"
FILES = shown_files(PAGE)
QUICK = ["preset=smoke", "bcq.updates_per_epoch=10", "distill.updates=10", "workers=1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's files, and the demonstrations that its script writes."""
    folder = tmp_path_factory.mktemp("mine")
    for name, text in FILES.items():
        text = text.replace("range(20)", "range(4)").replace("range(200)", "range(30)")
        (folder / name).write_text(
            text.replace("steps=200", "steps=30").replace("steps: 200", "steps: 30")
        )
    subprocess.run([sys.executable, "gaits.py"], cwd=folder, check=True)
    return folder


def test_the_files_of_tasks_have_at_most_twenty_lines() -> None:
    tasks = [text for name, text in FILES.items() if name.endswith(".yaml")]
    assert len(tasks) == 3
    assert all(len(text.splitlines()) <= 20 for text in tasks)


@pytest.mark.slow
def test_gymnasium_tasks_run_from_files_to_the_report(folder: Path) -> None:
    done = recipe("two_stage", *QUICK, "tasks=swimmer.yaml", "run_dir=run", cwd=folder)
    assert done.returncode == 0, done.stderr
    rows = read_results(folder / "run" / "results.csv")
    found = {(row.task, row.policy) for row in rows}
    tasks = ("forward", "backward", "still")
    assert found == {(task, policy) for task in tasks for policy in ("expert", "bcq", "distilled")}
    assert all(row.success is None for row in rows)
    assert "| Backward | Distilled | prototype |" in done.stdout
    assert (folder / "run" / "report.html").exists()


@pytest.mark.slow
def test_a_run_goes_on_from_its_folder_after_the_task_file_is_gone(folder: Path) -> None:
    command = [*QUICK, "run_dir=again"]
    assert recipe("collect", *command, "tasks=files.yaml", cwd=folder).returncode == 0
    (folder / "files.yaml").rename(folder / "moved.yaml")
    done = recipe("train_bcq", "run_dir=again", cwd=folder)
    (folder / "moved.yaml").rename(folder / "files.yaml")
    assert done.returncode == 0, done.stderr
    assert (folder / "again" / "bcq" / "backward" / "checkpoint.safetensors").exists()


@pytest.mark.slow
def test_files_without_an_environment_are_judged_on_held_out_demonstrations(folder: Path) -> None:
    done = recipe("two_stage", *QUICK, "tasks=files.yaml", "run_dir=files", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "some tasks have no environment" in done.stderr
    rows = read_rows(folder / "files" / "held_out.csv", COLUMNS)
    assert [row["task"] for row in rows] == ["forward", "backward"]
    assert not (folder / "files" / "results.csv").exists()
    # Both files share the range of all their actions.
    bounds = [
        read_original_bounds(folder / "files" / "data" / f"{task}.hdf5")
        for task in ("forward", "backward")
    ]
    assert bounds[0] == bounds[1]


@pytest.mark.robosuite
@pytest.mark.slow
def test_two_tasks_run_with_a_panda(folder: Path) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    text = (folder / "panda.yaml").read_text().replace("Panda}", "Panda, horizon: 10}")
    (folder / "short.yaml").write_text(text)
    done = recipe("two_stage", *QUICK, "tasks=short.yaml", "run_dir=panda", cwd=folder)
    assert done.returncode == 0, done.stderr
    rows = read_results(folder / "panda" / "results.csv")
    assert {row.task for row in rows} == {"reach", "lift"}
