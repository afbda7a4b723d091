"""A run as an object: its lock, its tasks, its copies in workers."""

from __future__ import annotations

import pickle
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("h5py")
pytest.importorskip("gymnasium")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")
pytest.importorskip("yaml")

import numpy as np
from episode_files import make_episode

from torchrl_bmrl.data.demonstrations import write_statistics
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.errors import BMRLError, ConfigError, FolderInUseError, UnknownNameError
from torchrl_bmrl.pipeline import (
    CollectSettings,
    Run,
    Settings,
    collect,
    evaluate,
    export,
    stage1,
    stage2,
    two_stage,
)
from torchrl_bmrl.run.folder import read_settings
from torchrl_bmrl.run.workers import Report


def make(folder: Path, **settings: Any) -> Run:
    settings = {"tasks": ["reach", "lift"], "workers": 1} | settings
    return Run(Settings(run_dir=str(folder), **settings))


def name_of(job: tuple[Run, int], report: Report) -> tuple[str, int, int]:
    run, number = job
    report(1)
    return run.names[number], run.seed("job", number), run.horizon(run.tasks[number])


OPTIONS: dict[str, Any] = {"total": 2, "description": "naming", "unit": "task"}


def test_a_run_that_is_not_open_refuses_work_and_writes_nothing(tmp_path: Path) -> None:
    run = make(tmp_path / "run")
    with pytest.raises(BMRLError, match="run is not open; valid: with Run"):
        run.jobs(name_of, [0, 1], **OPTIONS)
    for stage in (collect, stage1, stage2, evaluate, export, two_stage):
        with pytest.raises(BMRLError, match="is not open"):
            stage(run)
    assert list(tmp_path.iterdir()) == []
    with run:
        run.check_open()
    with pytest.raises(BMRLError, match="is not open"):
        run.check_open()


def test_a_task_may_be_named_run(tmp_path: Path) -> None:
    """The name under which the whole run is locked is no task's."""
    with make(tmp_path, tasks={"run": {"task": "lift"}}) as run:
        assert run.names == ("run",)


def test_a_run_can_be_opened_again_after_it_was_closed(tmp_path: Path) -> None:
    run = make(tmp_path)
    for _ in range(2):
        with run:
            assert run.jobs(name_of, [0], **OPTIONS)[0][0] == "reach"


def test_a_run_that_fails_gives_up_its_folder(tmp_path: Path) -> None:
    run = make(tmp_path / "run")
    with pytest.raises(KeyError), run:
        raise KeyError("robot")
    with make(tmp_path / "run"):
        pass


@pytest.mark.parametrize("opened", [False, True])
def test_a_copy_of_a_run_knows_the_same_and_holds_no_lock(tmp_path: Path, opened: bool) -> None:
    run = make(tmp_path)
    if opened:
        with run:
            copy = pickle.loads(pickle.dumps(run))
            with pytest.raises(FolderInUseError):
                copy.__enter__()
    else:
        copy = pickle.loads(pickle.dumps(run))
    assert copy.settings == run.settings
    assert (copy.folder, copy.names) == (run.folder, run.names)
    with pytest.raises(BMRLError, match="is not open"):
        copy.check_open()
    with copy:  # where nobody holds it
        copy.check_open()


@pytest.mark.slow
def test_jobs_are_the_same_in_workers_and_here(tmp_path: Path) -> None:
    with make(tmp_path) as run:
        here = run.jobs(name_of, [0, 1], **OPTIONS)
        there = run.jobs(name_of, [0, 1], workers=2, **OPTIONS)
    assert here == there
    assert [name for name, _, _ in here] == ["reach", "lift"]


def test_a_folder_is_one_runs_at_a_time(tmp_path: Path) -> None:
    with make(tmp_path), pytest.raises(FolderInUseError), make(tmp_path):
        pass


def test_runs_of_only_other_tasks_share_a_folder_and_no_others_do(tmp_path: Path) -> None:
    with make(tmp_path, only=["reach"]):
        with make(tmp_path, only=["lift"]):
            pass
        for only in (["reach"], ["lift", "reach"], None):
            with pytest.raises(FolderInUseError), make(tmp_path, only=only):
                pass


def test_the_folder_says_the_settings_with_tasks_and_numbers_written_out(tmp_path: Path) -> None:
    run = make(tmp_path, tasks=None, collect=CollectSettings(train_episodes={"default": 3}))
    with run:
        pass
    kept = read_settings(tmp_path)
    assert kept["tasks"] == list(run.names)
    assert kept["collect"]["train_episodes"] == dict.fromkeys(run.names, 3)
    assert Settings(**{**kept, **nested(run)}).deciding() == run.settings.deciding()
    other = make(tmp_path, tasks=None, seed=1, collect=run.settings.collect)
    with pytest.raises(ConfigError, match="seed is 1 here and 0"), other:
        pass


def nested(run: Run) -> dict[str, Any]:
    """The sections of the settings as objects."""
    names = ("collect", "bcq", "distill", "evaluate")
    return {name: getattr(run.settings, name) for name in names}


# -- tasks -----------------------------------------------------------------------------------------


def test_a_task_file_is_read_once_and_stored_in_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("short: {task: reach, horizon: 7, title: Short reach}\nlift: {task: lift}\n")
    run = make(tmp_path / "run", tasks=str(path))
    assert run.names == ("short", "lift")
    assert run.titles == {"short": "Short reach", "lift": "Lift"}
    assert run.horizon(run.task("short")) == 7
    with run:
        path.unlink()
    again = Run(Settings(run_dir=str(run.folder), tasks=read_settings(run.folder)["tasks"]))
    assert again.tasks == run.tasks
    with again:
        pass


def test_settings_of_a_run_reach_the_tasks_that_have_the_option(tmp_path: Path) -> None:
    made = make(tmp_path, stepper="robosuite", robot="Panda")
    assert {task.options["stepper"] for task in made.tasks} == {"robosuite"}
    assert {task.options["robot"] for task in made.tasks} == {"Panda"}
    files = {"door": {"demonstrations": str(tmp_path / "door.hdf5")}}
    assert make(tmp_path, tasks=files, stepper="robosuite").tasks[0].options == {}
    with pytest.raises(ConfigError, match="robot is Panda; valid for tasks without robosuite"):
        make(tmp_path, tasks=files, robot="Panda")


def test_a_composition_has_the_tasks_of_the_run_with_their_options(tmp_path: Path) -> None:
    run = make(tmp_path, stepper="robosuite")
    both = run.composition("reach-lift")
    assert both.name == "reach-lift"
    assert both.options["stepper"] == "robosuite"
    assert run.horizon(both) == 200
    assert run.composition("lift") == run.task("lift")
    for name in ("reach-push_up", "push_up"):
        with pytest.raises(UnknownNameError, match=r"task of the run 'push_up'.*: reach, lift"):
            run.composition(name)
    files = {"door": {"demonstrations": "door.hdf5"}, "box": {"demonstrations": "box.hdf5"}}
    with pytest.raises(ConfigError, match="the tasks door, box cannot follow each other"):
        make(tmp_path, tasks=files).composition("door-box")


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"only": []}, r"only is \[\]; valid: some of"),
        ({"only": ["lift", "lift"]}, "each once"),
        ({"only": ["push_up"]}, "only is .*valid: some of .'reach', 'lift'"),
        ({"tasks": []}, "at least one task"),
        ({"tasks": ["lift", "lift"]}, "each once"),
        ({"tasks": ["lfit"]}, "unknown task 'lfit'"),
        ({"tasks": 3}, "tasks is 3; valid: a list of names, or a YAML file"),
        ({"collect": CollectSettings(train_episodes={})}, "has nothing; valid: a number for reach"),
        ({"collect": CollectSettings(train_episodes={"reach": 1})}, "a number for lift"),
        (
            {"collect": CollectSettings(train_episodes={"default": 1, "lfit": 1})},
            "unknown task 'lfit'",
        ),
        ({"collect": CollectSettings(after={"lfit": ["reach"]})}, "unknown task 'lfit'"),
        ({"collect": CollectSettings(after={"lift": ["", "reach-lfit"]})}, "unknown task 'lfit'"),
    ],
)
def test_tasks_that_do_not_exist_or_come_twice_are_refused_before_anything_is_written(
    tmp_path: Path, settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(BMRLError, match=says):
        make(tmp_path / "run", **settings)
    assert list(tmp_path.iterdir()) == []


def test_the_horizon_of_files_is_their_longest_training_demonstration(tmp_path: Path) -> None:
    parts = {"arm": ((3,), np.float64)}
    episodes = [make_episode(i, steps, parts=parts) for i, steps in enumerate((5, 9, 40))]
    files = {"door": {"demonstrations": str(tmp_path / "door.hdf5")}}
    run = make(tmp_path / "run", tasks=files)
    assert run.task("door").horizon is None
    path = run.demonstrations("door")
    path.parent.mkdir(parents=True)
    write_episodes(path, episodes, env_args={}, masks={"train": [0, 1], "valid": [2]})
    write_statistics(run.data_dir, run.tasks)
    assert run.horizon(run.task("door")) == 9
    fixed = make(tmp_path / "run", tasks={"door": files["door"] | {"horizon": 4}})
    assert fixed.horizon(fixed.task("door")) == 4


def test_what_is_made_once_is_read_back(tmp_path: Path) -> None:
    run, calls = make(tmp_path), []

    def write(path: Path) -> None:
        calls.append(path)
        path.write_text("made")

    for _ in range(2):
        assert run.once("a.txt", Path.read_text, write) == "made"
    assert calls == [tmp_path / "a.txt"]


def test_seeds_differ_by_purpose_and_by_run(tmp_path: Path) -> None:
    runs = [make(tmp_path, seed=seed) for seed in (0, 1)]
    seeds = [run.seed(*names) for run in runs for names in (("bcq", "lift"), ("bcq", "reach"))]
    assert len(set(seeds)) == 4
    assert runs[0].seed("bcq", "lift") == make(tmp_path).seed("bcq", "lift")
    assert asdict(runs[0].settings)["seed"] == 0
