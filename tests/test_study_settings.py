"""A study's settings: taken from its own folder, and its folder is only made for valid ones."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import settings_of, started, study_run

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.pipeline import Run
from torchrl_bmrl.run.folder import flat, open_run
from torchrl_bmrl.studies.baselines import BaselineSettings, baselines
from torchrl_bmrl.studies.fqe import FQESettings, fqe
from torchrl_bmrl.studies.imitation import ImitateSettings, imitate
from torchrl_bmrl.studies.interpolation import InterpolationSettings, interpolate
from torchrl_bmrl.studies.latent_sac import LatentSACSettings, latent_sac
from torchrl_bmrl.studies.people import HumanSettings, learn_from_people

STUDIES = [
    ("imitate", ImitateSettings(demonstrations=2, magnitude=(0.5, 2.0))),
    ("interpolate", InterpolationSettings(eef="hand")),
    ("latent_sac", LatentSACSettings(eval_episodes=3)),
    ("fqe", FQESettings(checkpoints=[3, 6])),
    ("baselines", BaselineSettings(updates=7)),
    ("learn_from_people", HumanSettings(path="demo.hdf5")),
]


@pytest.fixture
def begun(recipes: Any, tmp_path: Path) -> Path:
    """The folder of a run in which every study was begun."""
    pytest.importorskip("robosuite", exc_type=ImportError)
    run = Run(settings_of("preset=smoke", f"run_dir={tmp_path}"))
    open_run(tmp_path, asdict(run.settings))
    for _, settings in STUDIES:
        open_run(tmp_path / settings.folder, asdict(settings))
    return tmp_path


def started_study(recipe: str, *overrides: str) -> tuple[int, list[Any]]:
    import command

    return started(command, recipe, *overrides)


@pytest.mark.parametrize(("recipe", "expected"), STUDIES)
def test_a_study_takes_what_a_command_does_not_give_from_its_own_folder(
    begun: Path, recipe: str, expected: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    code, (_, study) = started_study(recipe, f"run_dir={begun}")
    assert code == 0
    assert dict(flat(asdict(study))) == dict(flat(asdict(expected)))
    assert f"{begun / expected.folder}: other settings are read" in capsys.readouterr().err


def test_a_setting_that_a_command_gives_is_kept(begun: Path) -> None:
    _, (_, study) = started_study("fqe", f"run_dir={begun}", "fqe.updates=5")
    assert study == replace(STUDIES[3][1], updates=5)


def test_settings_that_name_another_folder_take_nothing_from_this_one(begun: Path) -> None:
    _, (_, study) = started_study("latent_sac", f"run_dir={begun}", "latent_sac.hold=7")
    assert study == LatentSACSettings(hold=7)


@pytest.mark.parametrize(
    ("function", "settings"),
    zip(
        [imitate, interpolate, latent_sac, fqe, baselines, learn_from_people],
        [settings for _, settings in STUDIES],
        strict=True,
    ),
)
def test_a_study_of_a_run_that_is_not_open_leaves_no_file(
    tmp_path: Path, function: Any, settings: Any
) -> None:
    with pytest.raises(BMRLError, match="is not open"):
        function(study_run(tmp_path), settings)
    assert list(tmp_path.iterdir()) == []
