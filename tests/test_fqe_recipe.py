"""Fitted Q evaluation of a series of agents: what is kept, what is compared, what is refused."""

from __future__ import annotations

import csv
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

from omegaconf import OmegaConf
from small_runs import Run, configured, contents

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.training.checkpoint import load_checkpoint

SERIES = ["fqe.checkpoints=[3,6,12]", "fqe.updates=8", "fqe.num_candidates=3"]
UPDATES = [3, 6, 12]


@pytest.fixture(scope="module")
def studied(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with demonstrations, stage 1 and the study."""
    import collect
    import fqe
    import train_bcq

    folder = tmp_path_factory.mktemp("studied")
    for stage in (collect.collect, train_bcq.train_all, fqe.fqe):
        run(folder, stage, *SERIES, "evaluate.episodes=2")
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
def test_what_is_there_is_read_back_and_what_is_missing_made_again_the_same(
    run: Run, studied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import fqe

    before = contents(studied, "fqe/**/*.csv", "fqe.csv", "tables/fqe.*")
    files = list((studied / "fqe").glob("*/*"))
    written = {path: path.stat().st_mtime_ns for path in files}
    (studied / "fqe" / "lift" / "6.csv").unlink()
    run(studied, fqe.fqe, *SERIES, "evaluate.episodes=2")
    assert contents(studied, "fqe/**/*.csv", "fqe.csv", "tables/fqe.*") == before
    again = [path.name for path in files if path.stat().st_mtime_ns != written[path]]
    assert again == ["6.csv"]
    with pytest.raises(SystemExit):
        run(studied, fqe.fqe, *SERIES[:2], "evaluate.episodes=2")
    assert "num_candidates is 10 here and 3 in the folder's run" in capsys.readouterr().err


@pytest.mark.robosuite
def test_without_demonstrations_it_says_what_writes_them(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import fqe

    with pytest.raises(SystemExit):
        run(tmp_path, fqe.fqe)
    assert "recipes/collect.py writes it" in capsys.readouterr().err
    assert not (tmp_path / "fqe").exists()


def test_the_table_tells_the_agent_that_would_be_chosen(recipes: Any) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    import fqe

    numbers = {"reach": ([1, 3, 2], [10, 45, 20]), "lift": ([3, 1, 2], [10, 45, 20])}
    rows = [
        {"task": task, "updates": updates, "estimate": estimate, "return": value, "success": 0.0}
        for task, parts in numbers.items()
        for updates, estimate, value in zip((5, 10, 20), *parts, strict=True)
    ]
    table = fqe.make_table(rows, ["reach", "lift"])
    found = [(line[0], line[1].split()[0], *line[2:]) for line in table.rows]
    assert found == [
        ("Reach", "1.00", "25.0", "45.0", "20.0", "45.0", "10"),
        ("Lift", "-1.00", "25.0", "45.0", "20.0", "10.0", "5"),
        ("All", "0.00", "25.0", "45.0", "20.0", "27.5", ""),
    ]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("fqe.checkpoints=[5]", r"fqe.checkpoints is \[5\]; valid: at least two"),
        ("fqe.checkpoints=[5,5]", "valid: at least two, from low to high"),
        ("fqe.checkpoints=[9,5]", "valid: at least two, from low to high"),
        ("fqe.checkpoints=[0,5]", r"fqe.checkpoints is \[0, 5\]; valid: above 0"),
        ("fqe.updates=0", "fqe.updates is 0; valid: above 0"),
        ("fqe.tau=2", "fqe.tau is 2.0; valid: between 0 and 1"),
    ],
)
def test_settings_that_make_no_series_are_refused(
    recipes: Any, tmp_path: Path, override: str, says: str
) -> None:
    config = OmegaConf.to_object(configured("preset=smoke", f"run_dir={tmp_path}", override))
    with pytest.raises(ConfigError, match=says):
        recipes.check_settings(config)
