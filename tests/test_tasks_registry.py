"""Tasks by name: registered, replaced, from modules, several in a row."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

from torchrl_bmrl import tasks
from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.families import registered_families
from torchrl_bmrl.tasks import (
    DemonstrationFiles,
    Task,
    compose_tasks,
    get_task,
    register_task,
    registered_tasks,
)

SIX = ("reach", "lift", "push_right", "push_left", "push_up", "push_down")


@pytest.fixture(autouse=True)
def registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone afterwards."""
    registered_tasks()
    monkeypatch.setattr(tasks, "_registry", dict(tasks._registry))


def door(name: str = "door", **options: object) -> Task:
    return Task(name=name, files=DemonstrationFiles(path="door.hdf5"), **options)  # type: ignore[arg-type]


def test_the_six_tasks_are_registered_in_their_order() -> None:
    assert registered_tasks()[:6] == SIX
    assert [get_task(name).name for name in SIX] == list(SIX)


def test_a_registered_task_is_found_by_its_name() -> None:
    task = register_task(door())
    assert get_task("door") is task
    assert registered_tasks()[-1] == "door"


def test_a_later_task_of_the_same_name_replaces_the_earlier_one_in_its_place() -> None:
    register_task(door())
    register_task(door("box"))
    later = register_task(door(horizon=7))
    assert get_task("door") is later
    assert registered_tasks()[-2:] == ("door", "box")


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    (tmp_path / "my_tasks.py").write_text(
        "from torchrl_bmrl.tasks import DemonstrationFiles, Task, register_task\n"
        "files = DemonstrationFiles(path='door.hdf5')\n"
        "register_task(Task(name='window', files=files))\n"
    )
    (tmp_path / "broken_tasks.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "my_tasks"
    sys.modules.pop("my_tasks", None)


def test_a_module_before_the_name_is_imported_first(module: str) -> None:
    with pytest.raises(UnknownNameError):
        get_task("window")
    assert get_task(f"{module}:window").name == "window"
    assert get_task("window").name == "window"


@pytest.mark.parametrize("name", ["no_such_module:window", "broken_tasks:window"])
def test_a_module_that_cannot_be_imported_is_named_with_its_reason(module: str, name: str) -> None:
    with pytest.raises(ConfigError, match=rf"task {name}: .* cannot be imported \(No module named"):
        get_task(name)


def test_a_module_that_does_not_register_the_name_is_refused(module: str) -> None:
    with pytest.raises(UnknownNameError, match="unknown task 'wall'"):
        get_task(f"{module}:wall")


@pytest.mark.parametrize("name", ["lfit", "reach-lfit", "lfit-reach", "", "reach-", "Lift"])
def test_an_unknown_name_is_refused_with_all_that_are_known(name: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        get_task(name)
    assert caught.value.valid == (*registered_tasks(), *registered_families())
    assert all(known in str(caught.value) for known in SIX)


def test_several_names_are_one_task_after_the_other() -> None:
    both = get_task("reach-lift-reach")
    assert (both.name, both.horizon) == ("reach-lift-reach", 300)
    composed = compose_tasks([get_task(name) for name in ("reach", "lift", "reach")])
    assert (composed.name, composed.options) == (both.name, both.options)
    assert compose_tasks([get_task("lift")]) is get_task("lift")
    sent = pickle.loads(pickle.dumps(both))
    assert (sent.name, sent.options, sent.horizon) == (both.name, both.options, both.horizon)


def test_tasks_that_cannot_follow_each_other_are_refused_by_name() -> None:
    register_task(door())
    for name in ("door-door", "reach-door", "door-reach"):
        with pytest.raises(ConfigError, match=f"the tasks {name.replace('-', ', ')} cannot"):
            get_task(name)


@pytest.mark.parametrize("name", ["", "a b", "a/b", "../a", ".hidden", "a-b", "ä", "a\n"])
def test_a_name_that_names_no_file_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"name is .*valid: letters, digits"):
        door(name)


@pytest.mark.parametrize("name", ["a", "door2", "Door_open", "a.b"])
def test_a_name_of_letters_and_digits_is_taken(name: str) -> None:
    assert door(name).name == name


def test_a_task_has_one_source_of_demonstrations() -> None:
    files = DemonstrationFiles(path="door.hdf5")
    for given in ({}, {"files": files, "record": get_task("lift").record}):
        with pytest.raises(ConfigError, match="task door needs demonstrations; valid: record or"):
            Task(name="door", **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("horizon", [0, -1])
def test_an_episode_without_steps_is_refused(horizon: int) -> None:
    with pytest.raises(ConfigError, match=f"horizon of task door is {horizon}; valid: a whole"):
        door(horizon=horizon)


def test_options_of_a_copy_are_its_own_and_unknown_ones_are_refused() -> None:
    lift = get_task("lift")
    name = next(iter(lift.options))
    changed = lift.with_options(**{name: "other"})
    assert changed.options == {**lift.options, name: "other"}
    assert get_task("lift").options[name] != "other"
    with pytest.raises(UnknownNameError, match="option of task lift 'colour'") as caught:
        lift.with_options(colour=1)
    assert caught.value.valid == tuple(lift.options)
