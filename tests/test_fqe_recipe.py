"""Fitted Q evaluation of a series of agents: what is kept, what is compared, what is refused."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import Interruption, contents, study_run

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.pipeline import (
    collect,
    stage1,
)
from torchrl_bmrl.run.settings import check_settings
from torchrl_bmrl.studies.fqe import FQESettings, fqe, make_table, train_job
from torchrl_bmrl.training.checkpoint import load_checkpoint

UPDATES = [3, 6, 12]
SERIES = FQESettings(checkpoints=UPDATES, updates=8, num_candidates=3)


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with demonstrations, stage 1 and the study."""
    pytest.importorskip("robosuite", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("studied")
    with study_run(folder) as run:
        collect(run)
        stage1(run)
        assert "| Reach |" in fqe(run, SERIES)
    return folder


@pytest.mark.robosuite
@pytest.mark.slow
def test_every_agent_of_the_series_has_an_estimate_and_a_return(studied: Path) -> None:
    rows = list(csv.DictReader((studied / "fqe.csv").open()))
    expected = [(task, str(updates)) for task in ("reach", "lift") for updates in UPDATES]
    assert [(row["task"], row["updates"]) for row in rows] == expected
    for key in ("estimate", "return"):
        assert len({row[key] for row in rows}) == len(rows)
    table = (studied / "tables" / "fqe.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table] == ["Task", "Reach", "Lift", "All"]
    assert (studied / "studies" / "fqe.json").exists()


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_series_is_stage_1s_own_agent_on_its_way(studied: Path) -> None:
    for task in ("reach", "lift"):
        path = studied / "bcq" / task / "checkpoint.safetensors"
        final, metadata = load_checkpoint(path, kind="bcq")
        assert metadata["updates"] == 12
        same = []
        for updates in UPDATES:
            path = studied / "fqe" / task / f"{updates}.safetensors"
            state, said = load_checkpoint(path, kind="bcq")
            assert (said["updates"], said["task"]) == (updates, task)
            pairs = zip(state["module"].values(), final["module"].values(), strict=True)
            same.append(all(torch.equal(a, b) for a, b in pairs))
        assert same == [False, False, True]


@pytest.mark.robosuite
@pytest.mark.slow
def test_what_is_there_is_read_back_and_what_is_missing_made_again_the_same(studied: Path) -> None:
    before = contents(studied, "fqe/**/*.csv", "fqe.csv", "tables/fqe.*")
    files = list((studied / "fqe").glob("*/*"))
    written = {path: path.stat().st_mtime_ns for path in files}
    (studied / "fqe" / "lift" / "6.csv").unlink()
    with study_run(studied) as run:
        fqe(run, SERIES)
        assert contents(studied, "fqe/**/*.csv", "fqe.csv", "tables/fqe.*") == before
        again = [path.name for path in files if path.stat().st_mtime_ns != written[path]]
        assert sorted(again) == ["6.csv", "6.csv.sha256"]  # and of which agent it is
        with pytest.raises(BMRLError, match="num_candidates is 10 here and 3 in the folder's run"):
            fqe(run, FQESettings(checkpoints=UPDATES, updates=8))


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_stopped_series_saves_no_agent_between_its_numbers(studied: Path, tmp_path: Path) -> None:
    shutil.copytree(studied / "data", tmp_path / "data")
    job = (study_run(tmp_path), ("lift", UPDATES))
    with pytest.raises(StoppedError):
        train_job(job, Interruption(4, StoppedError))
    assert [path.name for path in (tmp_path / "fqe" / "lift").iterdir()] == ["3.safetensors"]
    train_job(job, lambda _: None)
    series = "fqe/lift/*.safetensors"
    assert contents(tmp_path, series) == contents(studied, series)


@pytest.mark.robosuite
def test_without_demonstrations_the_error_names_the_recipe_that_writes_them(tmp_path: Path) -> None:
    with study_run(tmp_path) as run:
        with pytest.raises(BMRLError, match=r"recipes/collect.py writes it"):
            fqe(run, SERIES)
        assert not (tmp_path / "fqe").exists()


def test_the_table_tells_the_agent_that_would_be_chosen() -> None:
    numbers = {"reach": ([1, 3, 2], [10, 45, 20]), "lift": ([13, 11, 12], [110, 145, 120])}
    rows = [
        {"task": task, "updates": updates, "estimate": estimate, "return": value, "success": 0.0}
        for task, parts in numbers.items()
        for updates, estimate, value in zip((5, 10, 20), *parts, strict=True)
    ]
    table = make_table(rows, {"reach": "Reach", "lift": "Lift"})
    found = [(line[0], line[1].split()[0], *line[2:]) for line in table.rows]
    assert found == [
        ("Reach", "1.00", "25.0", "45.0", "20.0", "45.0", "10"),
        ("Lift", "-1.00", "125.0", "145.0", "120.0", "110.0", "5"),
        ("All", "0.00", "75.0", "95.0", "70.0", "77.5", ""),
    ]


@pytest.mark.parametrize("series", [[5], [9, 5]])
def test_a_series_is_at_least_two_numbers_from_low_to_high(
    tmp_path: Path, series: list[int]
) -> None:
    with (
        study_run(tmp_path) as run,
        pytest.raises(BMRLError, match=r"fqe.checkpoints is .*; valid: at least two, from low"),
    ):
        fqe(run, FQESettings(checkpoints=series))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"checkpoints": [5, 5]}, r"fqe.checkpoints is \[5, 5\]; valid: .*each once"),
        ({"checkpoints": [0, 5]}, "fqe.checkpoints is 0; valid: above 0"),
        ({"updates": 0}, "fqe.updates is 0; valid: above 0"),
        ({"tau": 2.0}, "fqe.tau is 2.0; valid: above 0 and at most 1"),
    ],
)
def test_settings_that_are_not_valid_are_refused(values: dict[str, Any], says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        check_settings(FQESettings(**values), "fqe.")
