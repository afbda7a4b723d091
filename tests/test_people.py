"""Learning from human demonstrations: what agents train on, what is compared, what is refused."""

from __future__ import annotations

import csv
import shutil
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

import numpy as np
from episode_files import make_episode
from small_runs import HORIZON, TASKS, study_run, times

from torchrl_bmrl.data.robomimic import open_episodes, write_episodes
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.pipeline import (
    Run,
    Settings,
    collect,
)
from torchrl_bmrl.run.settings import check_settings
from torchrl_bmrl.studies import people
from torchrl_bmrl.studies.people import HumanSettings, learn_from_people, make_table


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"shares": [0, 1.5]}, "human.shares is 1.5; valid: at least 0 and at most 1"),
        ({"shares": [0.5, 0.5]}, "human.shares is .*; valid: at least one value, each once"),
        ({"tracking": 0.0}, "human.tracking is 0.0; valid: above 0"),
    ],
)
def test_settings_that_are_not_valid_are_refused(values: dict[str, Any], says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        check_settings(HumanSettings(**values), "human.")


@pytest.mark.parametrize("task", ["lift_to_height_8", "reach"])
def test_the_agents_are_those_of_the_named_task_beside_a_family(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: str
) -> None:
    taught: list[str] = []

    def alone(settings: Settings) -> Run:
        taught.extend(Run(settings).names)
        raise BMRLError("enough")

    monkeypatch.setattr(people, "Run", alone)
    settings = Settings(run_dir=str(tmp_path / "run"), tasks=["lift_to_height", "reach"])
    with pytest.raises(BMRLError, match="enough"), Run(settings) as run:
        learn_from_people(run, HumanSettings(path="any.hdf5", task=task))
    assert taught == [task]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({}, "human.path is empty; valid: a file or folder"),
        ({"path": "nowhere.hdf5"}, "nowhere.hdf5: no such file"),
        ({"path": "a", "task": "push_up"}, "unknown human.task 'push_up'; valid .*: reach, lift"),
    ],
)
def test_an_error_at_the_start_leaves_no_file(
    tmp_path: Path, values: dict[str, Any], says: str
) -> None:
    folder = tmp_path / "run"
    with pytest.raises(BMRLError, match=says), study_run(folder) as run:
        learn_from_people(run, HumanSettings(**values))
    assert not folder.exists()


def test_recordings_of_a_sawyer_are_refused_beside_another_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(people, "find_format", lambda path: "robosuite")
    values = HumanSettings(path="demo.hdf5", task="lift")
    with (
        pytest.raises(BMRLError, match=r"robot is Panda and demo.hdf5 .*; valid: null or Sawyer"),
        study_run(tmp_path / "run", robot="Panda") as run,
    ):
        learn_from_people(run, values)


@pytest.mark.parametrize("files", [False, True])
def test_human_actions_get_the_units_of_the_tasks_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: bool
) -> None:
    """Those of the imported demonstrations, or [-1, 1] of recorded ones."""
    human = make_episode(0)
    write_episodes(tmp_path / "human.hdf5", [human], env_args={}, bounds=(-2, 2))
    own = {"demonstrations": str(tmp_path / "human.hdf5"), "env": "Pendulum-v1"}
    monkeypatch.setattr(people, "collect", lambda run: None)
    monkeypatch.setattr(people, "read_original_bounds", lambda path: (-4.0, 4.0))
    monkeypatch.setattr(Run, "jobs", lambda *_, **__: pytest.fail("enough"))
    settings = Settings(run_dir=str(tmp_path / "run"), tasks={"lift": own} if files else ["lift"])
    with pytest.raises(pytest.fail.Exception, match="enough"), Run(settings) as run:
        learn_from_people(run, HumanSettings(path=str(tmp_path / "human.hdf5"), task="lift"))
    with open_episodes(tmp_path / "run" / "human" / "demonstrations.hdf5") as episodes:
        (episode,) = episodes.values()
    assert np.allclose(episode.actions, human.actions / (4 if files else 1), atol=1e-6)


def test_the_verdict_on_human_data_follows_from_the_interval() -> None:
    def rows(share: float, gain: float, noise: float) -> list[dict[str, Any]]:
        return [
            {
                "share": share,
                "training_seed": i % 2,
                "return": 100 + i + gain + noise * (-1) ** (i // 2),
                "success": i % 2,
            }
            for i in range(20)
        ]

    table = make_table(
        rows(0, 0, 0) + rows(0.1, 5, 1) + rows(0.2, -5, 1) + rows(0.3, 0.1, 5), "Lift"
    )
    assert table.rows[0] == ("0%", "109.5", "10 of 20", "", "", "")
    assert [line[-1] for line in table.rows[1:]] == ["helped", "hurt", "no difference to be seen"]
    assert table.rows[1][3] == "+5.0"
    few = make_table(rows(0, 0, 0)[:4] + rows(0.1, 5, 1)[:4], "Lift")
    assert few.rows[1][-1] == "too few episodes to tell"


@pytest.mark.robosuite
@pytest.mark.slow
def test_every_share_is_trained_on_its_transitions_compared_and_read_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    with study_run(tmp_path / "others", seed=1) as run:
        collect(run)
    # Any file with the task's observation may stand for human demonstrations.
    path = shutil.copy(run.demonstrations("lift"), tmp_path / "human.hdf5")
    settings = HumanSettings(path=str(path), shares=[1.0], training_seeds=1)
    folder = tmp_path / "run"
    with study_run(folder) as run:
        text = learn_from_people(run, settings)
        assert text == (folder / "tables" / "human.md").read_text()
        lines = (folder / "tables" / "human.csv").read_text().splitlines()[1:]
        assert [line.split(",")[0] for line in lines] == ["0%", "100%"]
        assert "0 of 2" in text
        assert "too few episodes" in text
        with (folder / "human.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert [row["share"] for row in rows] == ["0.0", "0.0", "1.0", "1.0"]
        assert not run.data_dir.exists()  # the run's own tasks are left alone
        before = times(folder)
        assert learn_from_people(run, settings) == text
        assert times(folder) == before
        with pytest.raises(BMRLError, match=r"path is other.hdf5 here and .*human.hdf5 in"):
            learn_from_people(run, HumanSettings(path="other.hdf5"))

    # Ten scripted transitions come first in the buffer, then the human ones.
    buffers: list[Any] = []
    monkeypatch.setattr(people, "train_agents", lambda *given, **_: buffers.append(given[2]))
    tasks = {"lift": TASKS["lift"]}
    alone = Run(Settings(run_dir=str(folder / "human" / "run"), tasks=tasks))
    for share in (0.0, 1.0):
        people.train_job((alone, (share, 0)), lambda _: None)
    scripted, human = (buffer.sample()["index"] for buffer in buffers)
    assert scripted.max() < HORIZON <= human.min()
