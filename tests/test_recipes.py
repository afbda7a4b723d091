"""Whole runs: from an empty folder to the report, the same bytes again, and what they print."""

from __future__ import annotations

import csv
import importlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

import yaml
from small_runs import SMALL, Run, contents, recipe, times

from torchrl_bmrl.evaluation import RESULT_FIELDS, read_results
from torchrl_bmrl.run import progress

pytestmark = [pytest.mark.robosuite, pytest.mark.slow]


def result_files(folder: Path) -> dict[str, bytes]:
    """Contents of the files that a run's results are read from."""
    return contents(folder, "results.csv", "tables/*", "bcq/*/evaluations.csv")


def test_two_stages_from_an_empty_folder_to_the_report_and_again(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    pytest.importorskip("matplotlib")
    overrides = [each for each in SMALL if not each.startswith("tasks=")]
    overrides += ["tasks=[reach,lift]"]  # full episodes, in which the experts succeed
    overrides += ["bcq.epochs=1", "evaluate.latent_sources=[online]", "run_dir=run", "workers=1"]
    done = recipe("two_stage", *overrides, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "report: run/report.html" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    folder = tmp_path / "run"

    with (folder / "results.csv").open() as file:
        assert tuple(csv.DictReader(file).fieldnames or ()) == RESULT_FIELDS
    rows = read_results(folder / "results.csv")
    counts = {
        (task, policy, source): sum(
            (row.task, row.policy, row.latent_source) == (task, policy, source) for row in rows
        )
        for task in ("reach", "lift")
        for policy, source in (("expert", ""), ("bcq", ""), ("distilled", "online"))
    }
    # The expert's rows are its two demonstrations of each task.
    assert list(counts.values()) == [2, 1, 1] * 2
    assert sum(counts.values()) == len(rows)
    assert all(0 < row.episode_return < 600 for row in rows)

    for name in ("results", "table1", "table2", "stages", "goal_distance"):
        assert "lift" in (folder / "tables" / f"{name}.csv").read_text().lower()
        assert "\n| Lift |" in (folder / "tables" / f"{name}.md").read_text()
    page = (folder / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    assert page.count("data:image/png;base64") >= 2
    assert "Explore the embedding" in page
    assert yaml.safe_load((folder / "config.yaml").read_text())["bcq"]["num_cells"] == [16, 16]
    versions = json.loads((folder / "versions.json").read_text())
    assert {"torch", "torchrl", "robosuite", "mujoco", "python", "torchrl_bmrl"} <= set(versions)
    assert set(json.loads((folder / "seconds.json").read_text())) == {
        "collect",
        "stage 1",
        "stage 2",
        "evaluate",
    }
    written = times(folder)
    for path in (
        "data/reach.hdf5",
        "data/lift.hdf5",
        "bcq/reach/checkpoint.safetensors",
        "bcq/lift/checkpoint.safetensors",
        "distill/checkpoint.safetensors",
        "evaluation/lift-distilled-online.csv",
    ):
        assert path in written
    assert list((folder / "logs").rglob("*.csv"))
    assert not [path for path in folder.rglob("*") if path.name.endswith(".tmp")]

    before = result_files(folder)
    done = recipe("two_stage", *overrides, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert times(folder) == written
    assert result_files(folder) == before


def test_a_one_hot_student_learns_from_the_same_agents_and_acts(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import two_stage
    from torchrl_bmrl.pipeline.student import load_student

    folder = run(
        tmp_path / "run",
        two_stage,
        "ablation=one_hot",
        "evaluate.latent_sources=[prototype]",
        f"base={finished}",
    )
    assert contents(folder, "data/*.hdf5") == contents(finished, "data/*.hdf5")
    pattern = "bcq/*/checkpoint.safetensors"
    assert contents(folder, pattern) == contents(finished, pattern)
    student, metadata = load_student(folder / "distill" / "checkpoint.safetensors")
    assert student.prototypes.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert metadata["accuracy"] == 1.0
    rows = read_results(folder / "results.csv")
    assert {row.latent_source for row in rows if row.policy == "distilled"} == {"prototype"}
    assert "The figures of the embedding are left out" in (folder / "report.html").read_text()


def test_one_seed_gives_the_same_bytes_in_one_go_and_recipe_by_recipe(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import collect, evaluate, stage1, stage2

    for stage in (collect, stage1, stage2, evaluate):
        run(tmp_path, stage)
    expected = result_files(finished)
    assert len(expected) == 1 + 8 + 2
    assert result_files(tmp_path) == expected
    costly = ("data/*", "**/*.safetensors")
    assert contents(tmp_path, *costly) == contents(finished, *costly)


def test_two_workers_give_the_same_bytes_as_one(finished: Path, tmp_path: Path) -> None:
    done = recipe("two_stage", *SMALL, "run_dir=run", "workers=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert result_files(tmp_path / "run") == result_files(finished)
    checkpoints = contents(finished, "**/*.safetensors")
    assert len(checkpoints) == 2 * 3 + 2
    assert contents(tmp_path / "run", "**/*.safetensors") == checkpoints


@pytest.mark.parametrize(("workers", "beside"), [(1, False), (2, True)])
def test_several_workers_evaluate_the_agents_beside_the_student_and_the_embedding_beside_episodes(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int, beside: bool
) -> None:
    """One process would draw for both from the same global generator."""
    stages, evaluation = (
        importlib.import_module(f"torchrl_bmrl.pipeline.{name}")
        for name in ("two_stage", "evaluate")
    )
    seen: dict[str, bool] = {}
    evaluate, look = stages.STAGES["evaluate"], evaluation.look_at_embedding

    def evaluated(run: Any) -> str:
        found = {path.name for path in (run.folder / "evaluation").glob("*")}
        seen["agents"] = {"reach-bcq.csv", "lift-bcq.csv", "lift-expert.csv"} <= found
        return evaluate(run)

    def looked(run: Any) -> dict[str, Any]:
        seen["embedding"] = not (run.folder / "results.csv").exists()
        return look(run)

    monkeypatch.setitem(stages.STAGES, "evaluate", evaluated)
    monkeypatch.setattr(evaluation, "look_at_embedding", looked)
    run(tmp_path / "run", stages.two_stage, f"workers={workers}")
    assert seen == {"agents": beside, "embedding": beside}


def test_a_run_goes_on_with_other_workers_but_not_with_other_settings(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    folder = shutil.copytree(finished, tmp_path / "run")
    before, written = result_files(folder), times(folder)
    with pytest.raises(SystemExit) as caught:
        run(folder, two_stage, "bcq.lr=0.1")
    assert caught.value.code == 1
    assert "bcq.lr is 0.1 here and 0.001 in the folder's run" in capsys.readouterr().err
    run(folder, two_stage, "workers=2", "logger=none")
    assert times(folder) == written
    assert result_files(folder) == before


def test_a_run_says_nothing_more_than_its_tables_unless_it_is_verbose(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    # On a slow machine, lines of progress would be printed too.
    monkeypatch.setattr(progress, "SOON", 600.0)
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    capsys.readouterr()
    run(folder, two_stage)
    quiet = capsys.readouterr()
    assert quiet.err == ""
    assert quiet.out.splitlines()[-1].startswith("collect 0.")
    run(folder, two_stage, "verbose=true")
    told = capsys.readouterr()
    assert told.out.splitlines()[:-1] == quiet.out.splitlines()[:-1]
    for line in (
        f"{folder}: two_stage, smoke",
        "bcq lift: resumed from update 12",
        "distillation: resumed from update 12",
        f"{folder / 'evaluation' / 'lift-bcq.csv'}: loaded",
        "stage 2: done",
    ):
        assert line in told.err.splitlines()
