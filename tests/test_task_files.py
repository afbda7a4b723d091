"""Files that describe a user's own tasks: what they mean, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")
pytest.importorskip("yaml")

import yaml

from torchrl_bmrl.envs.gym import make_gym_env
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.pipeline.task_files import make_tasks, read_task_file
from torchrl_bmrl.tasks import get_task


def test_a_file_gives_tasks_in_its_order_with_absolute_paths(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "door: {demonstrations: data/door.hdf5}\n"
        "box: {demonstrations: /elsewhere/box.hdf5}\n"
        "lift: {task: lift}\n"
    )
    entries = read_task_file(path)
    assert entries == {
        "door": {"demonstrations": str(tmp_path / "data" / "door.hdf5")},
        "box": {"demonstrations": "/elsewhere/box.hdf5"},
        "lift": {"task": "lift"},
    }
    assert [task.name for task in make_tasks(entries)] == ["door", "box", "lift"]


def test_a_path_in_a_relative_file_does_not_depend_on_where_a_later_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text("door: {demonstrations: door.hdf5}")
    monkeypatch.chdir(tmp_path)
    assert read_task_file("mine.yaml")["door"]["demonstrations"] == str(tmp_path / "door.hdf5")


def test_every_key_of_a_description_means_something() -> None:
    entry = {
        "demonstrations": "door.hdf5",
        "read": {"reward": "success"},
        "valid_share": 0.2,
        "env": "Pendulum-v1",
        "env_options": {"g": 9.0},
        "horizon": 70,
        "success": "is_success",
        "parts": ["arm", "door"],
        "title": "Open the door",
    }
    (task,) = make_tasks({"door": entry})
    assert task.files is not None
    assert (task.files.path, task.files.valid_share) == ("door.hdf5", 0.2)
    assert task.files.read == {"reward": "success"}
    assert task.make_env is make_gym_env
    assert task.options == {
        "env": "Pendulum-v1",
        "env_options": {"g": 9.0},
        "success": "is_success",
    }
    assert (task.horizon, task.success, task.title) == (70, "success", "Open the door")
    assert task.parts == ("arm", "door")
    (plain,) = make_tasks({"door": {"demonstrations": "door.hdf5"}})
    assert plain.make_env is plain.parts is plain.horizon is plain.success is None
    assert plain.files is not None
    assert (plain.title, plain.files.valid_share, plain.files.read) == ("Door", 0.1, {})


def test_a_registered_task_with_other_options_has_another_name() -> None:
    (task,) = make_tasks({"quick_lift": {"task": "lift", "horizon": 20, "title": "Quick"}})
    lift = get_task("lift")
    assert (task.name, task.title, task.horizon) == ("quick_lift", "Quick", 20)
    assert task.options == {**lift.options, "horizon": 20}
    assert (task.record, task.make_env) == (lift.record, lift.make_env)
    assert lift.horizon != 20


def test_names_alone_are_registered_tasks() -> None:
    lift, both = make_tasks(["lift", "reach-lift"])
    assert lift is get_task("lift")
    assert (both.name, both.options) == ("reach-lift", get_task("reach-lift").options)


@pytest.mark.parametrize(
    ("tasks", "says"),
    [
        ({}, r"tasks is \[\]; valid: at least one task"),
        ([], r"tasks is \[\]; valid: at least one task"),
        (["lift", "lift"], "each once"),
        ("lift", "tasks is 'lift'; valid: a list of names, or a YAML file of tasks"),
        (None, "tasks is None; valid: a list of names"),
        ([1.1], r"tasks is \[1.1\]; valid: a list of names"),
        (["lfit"], "unknown task 'lfit'"),
        ({"a": {"task": "lfit"}}, "unknown task 'lfit'"),
        ({"a": {"task": "lift", "colour": 1}}, "lift 'colour'; valid options of task lift: "),
        ({"a": {}}, r"task a has nothing; valid: demonstrations .* or task"),
        ({"a": {"env": "Pendulum-v1"}}, "task a has env; valid: demonstrations"),
        (
            {"a": {"demonstrations": "a.hdf5", "horizn": 3}},
            "task a: unknown key 'horizn'; valid: demonstrations, read, .*horizon",
        ),
        ({"a": {"demonstrations": "a.hdf5", "horizon": 0}}, "task a: horizon is 0; valid: a whole"),
        ({"a": {"task": "lift", "horizon": "long"}}, "horizon of task a is long; valid"),
        ({"a b": {"demonstrations": "a.hdf5"}}, "name is 'a b'; valid: letters"),
        ({"../a": {"demonstrations": "a.hdf5"}}, "name is '../a'; valid: letters"),
        ({"a-b": {"demonstrations": "a.hdf5"}}, "name is 'a-b'; valid: letters"),
        ({"a": {"demonstrations": "a.hdf5", "read": {"rewards": "x"}}}, "a: read: .*'rewards'"),
        ({"a": {"demonstrations": "a.hdf5", "read": {"reward": 3}}}, "reward"),
    ],
)
def test_what_is_no_task_is_refused_by_its_name(tasks: Any, says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        make_tasks(tasks)


@pytest.mark.parametrize(
    "change",
    [
        {"horizon": "long"},
        {"horizon": 2.5},
        {"horizon": True},
        {"valid_share": "many"},
        {"valid_share": 1.5},
        {"valid_share": -0.1},
        {"valid_share": float("nan")},
        {"parts": "arm"},
        {"parts": [1]},
        {"read": ["reward"]},
        {"env": 3},
        {"env_options": [1]},
        {"success": 3},
        {"demonstrations": 3},
        {"demonstrations": None},
    ],
    ids=str,
)
def test_a_value_of_another_kind_is_refused_by_task_and_key(change: dict[str, Any]) -> None:
    entry = {"demonstrations": "a.hdf5", "env": "Pendulum-v1"} | change
    (key,) = change
    with pytest.raises(ConfigError, match=rf"task a: {key} is .*; valid: "):
        make_tasks({"a": entry})


@pytest.mark.parametrize(
    ("text", "error", "says"),
    [
        (None, DataError, "no such file"),
        ("", BMRLError, "is empty; valid: a mapping"),
        ("{}", ConfigError, "no tasks; valid: a mapping from each task's name"),
        ("- door", BMRLError, "valid: a mapping"),
        ("door: door.hdf5", ConfigError, "task door is 'door.hdf5'; valid: a mapping"),
        ("door: {demonstrations: [", DataError, r"not YAML \([^\n]*\)$"),
        ("a: {task: lift}\na: {task: reach}", DataError, "contains the key a twice"),
        ("a: &a {x: *a}", DataError, "not YAML"),
        ("door: {demonstrations: a.hdf5, colour: red}", ConfigError, "unknown key 'colour'"),
    ],
)
def test_a_file_that_describes_no_tasks_is_refused(
    tmp_path: Path, text: str | None, error: type[Exception], says: str
) -> None:
    path = tmp_path / "mine.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(error, match=says):
        read_task_file(path)


def test_descriptions_survive_the_settings_of_a_run(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("door: {demonstrations: door.hdf5, valid_share: 0.2, parts: [arm]}\n")
    entries = read_task_file(path)
    assert make_tasks(yaml.safe_load(yaml.safe_dump(entries))) == make_tasks(entries)
