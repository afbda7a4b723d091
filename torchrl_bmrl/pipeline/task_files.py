"""Builds the tasks of a run from registered names, or from a YAML file of a user's tasks.

It also checks the settings that name tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.source_files import files_of
from torchrl_bmrl.envs.gym import make_gym_env
from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.families import tasks_of
from torchrl_bmrl.pipeline.settings import Settings
from torchrl_bmrl.run.folder import Files, read_yaml
from torchrl_bmrl.tasks import DemonstrationFiles, Task, get_task


def _is_text(x: Any) -> bool:
    return isinstance(x, str) and x != ""


def _is_mapping(x: Any) -> bool:
    return isinstance(x, Mapping)


_OF_FILES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "demonstrations": (_is_text, "a file or folder"),
    "read": (_is_mapping, "options by name"),
    "valid_share": (lambda x: isinstance(x, float | int) and 0 < x < 1, "a number between 0 and 1"),
    "env": (_is_text, "gymnasium's id"),
    "env_options": (_is_mapping, "options by name"),
    "horizon": (lambda x: isinstance(x, int) and x > 0, "a whole number above 0"),
    "success": (_is_text, "a key of info"),
    "parts": (lambda x: isinstance(x, list | tuple) and all(map(_is_text, x)), "a list of names"),
    "title": (_is_text, "a text"),
}
"""Keys of a task's description with their valid values; all but the first may be null."""


def read_task_file(path: str | Path) -> dict[str, dict[str, Any]]:
    """Reads a YAML file of tasks.

    Args:
        path: the file: a mapping from each task's name to its description.

    Returns:
        the descriptions by name; paths in them are absolute.

    Raises:
        DataError: if the file is missing or not YAML.
        ConfigError: if it does not describe tasks.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "mine.yaml"
        >>> _ = path.write_text("door: {demonstrations: /data/door.hdf5}")
        >>> read_task_file(path)
        {'door': {'demonstrations': '/data/door.hdf5'}}
    """
    path = Path(path)
    content = read_yaml(path)
    if not content:
        raise ConfigError(f"{path}: no tasks; valid: a mapping from each task's name to its keys")
    for name, entry in content.items():
        if not isinstance(entry, dict):
            raise ConfigError(f"{path}: task {name} is {entry!r}; valid: a mapping of keys")
    tasks = {str(name): dict(entry) for name, entry in content.items()}
    for entry in tasks.values():
        if isinstance(entry.get("demonstrations"), str):
            entry["demonstrations"] = str((path.parent / entry["demonstrations"]).absolute())
    make_tasks(tasks)
    return tasks


def make_tasks(tasks: Sequence[str] | Mapping[str, Mapping[str, Any]]) -> tuple[Task, ...]:
    """Returns the tasks that the settings describe.

    Args:
        tasks: names of tasks and families (:func:`~torchrl_bmrl.families.tasks_of`), or
            descriptions by name as in a :func:`read_task_file`.

    Returns:
        the tasks in their order; a task's class index is its position.

    Raises:
        UnknownNameError: for a name that is not registered.
        ConfigError: for an invalid description, no task, or a task that is given twice.

    Example:
        >>> [task.title for task in make_tasks(["lift", "push_left"])]
        ['Lift', 'Push left']
        >>> (task,) = make_tasks({"panda_lift": {"task": "lift"}})
        >>> task.name
        'panda_lift'
    """
    if isinstance(tasks, Mapping):
        made = [_make_task(name, entry) for name, entry in tasks.items()]
    elif isinstance(tasks, Sequence) and all(map(_is_text, tasks)) and not isinstance(tasks, str):
        made = [task for name in tasks for task in tasks_of(name)]
    else:
        raise ConfigError(f"tasks is {tasks!r}; valid: a list of names, or a YAML file of tasks")
    names = [task.name for task in made]
    if not made or len(set(names)) < len(names):
        raise ConfigError(f"tasks is {names}; valid: at least one task, each once")
    return tuple(made)


def _make_task(name: str, entry: Mapping[str, Any]) -> Task:
    """Builds a task: a registered task with other options, or one of a user's files."""
    if "task" in entry:
        task = get_task(str(entry["task"]))
        options = {key: x for key, x in entry.items() if key not in ("task", "title")}
        return replace(
            task.with_options(**options),
            name=name,
            horizon=options.get("horizon", task.horizon),
            title=str(entry.get("title", "")),
        )
    if "demonstrations" not in entry:
        raise ConfigError(
            f"task {name} has {', '.join(entry) or 'nothing'}; valid: demonstrations (a file or "
            "folder) or task (the name of a registered one)"
        )
    for key, value in entry.items():
        if key not in _OF_FILES:
            raise ConfigError(f"task {name}: unknown key {key!r}; valid: {', '.join(_OF_FILES)}")
        is_valid, valid = _OF_FILES[key]
        missing = value is None and key != "demonstrations"
        if not missing and (isinstance(value, bool) or not is_valid(value)):
            raise ConfigError(f"task {name}: {key} is {value!r}; valid: {valid}")
    read = entry.get("read") or {}
    try:
        ReadOptions.from_mapping(read)  # raises its error now and not in the middle of a run
    except BMRLError as error:
        raise ConfigError(f"task {name}: read: {error}") from error
    parts, env, success = entry.get("parts"), entry.get("env"), entry.get("success")
    files = DemonstrationFiles(
        path=str(entry["demonstrations"]),
        read=read,
        valid_share=float(entry.get("valid_share") or 0.1),
    )
    options = {"env": env, "env_options": entry.get("env_options"), "success": success}
    return Task(
        name=name,
        files=files,
        make_env=None if env is None else make_gym_env,
        options={} if env is None else options,
        parts=None if parts is None else tuple(parts),
        horizon=entry.get("horizon"),
        success=None if success is None else "success",
        title=str(entry.get("title") or ""),
    )


def with_run_options(task: Task, settings: Settings) -> Task:
    """Returns the task with the run's robot and stepper, if it has these options."""
    chosen = {"stepper": settings.stepper, "robot": settings.robot}
    known = {key: x for key, x in chosen.items() if x is not None and key in task.options}
    return task.with_options(**known)


def input_files(settings: Settings, tasks: Sequence[Task]) -> Files:
    """Returns the files outside of the run folder that decide a run's results, by setting."""
    found = {
        f"tasks.{task.name}.demonstrations": files_of(task.files.path)
        for task in tasks
        if task.files is not None
    }
    policy = settings.evaluate.policy
    return found | ({"evaluate.policy": files_of(policy)} if policy else {})


def check_names(settings: Settings, tasks: Sequence[Task]) -> None:
    """Raises an error for settings of unknown tasks; other registered tasks are allowed."""
    episodes, after = settings.collect.train_episodes, settings.collect.after
    experts, names = settings.collect.experts, [task.name for task in tasks]
    parts = [part for entries in after.values() for entry in entries for part in entry.split("-")]
    for name in [*episodes, *after, *experts, *filter(None, parts)]:
        if name not in ("default", *names):
            get_task(name)
    for task in tasks:
        if task.record is None and task.name in experts:
            raise ConfigError(
                f"collect.experts has {task.name}, whose demonstrations are files; valid: tasks "
                "with a scripted expert, or default"
            )


def check_playable(tasks: Sequence[Task]) -> None:
    """Checks that every task has an environment.

    Args:
        tasks: of a run, and others that it plays.

    Raises:
        ConfigError: naming the tasks without one.
    """
    if without := [task.name for task in tasks if task.make_env is None]:
        raise ConfigError(
            f"{', '.join(without)} of tasks have no environment; valid: tasks that have one"
        )


def train_episodes(settings: Settings, tasks: Sequence[Task]) -> dict[str, int]:
    """Returns the number of episodes to record for each task."""
    given = settings.collect.train_episodes
    recorded = [task.name for task in tasks if task.record is not None]
    for name in recorded:
        if name not in given and "default" not in given:
            raise ConfigError(
                f"collect.train_episodes has {', '.join(given) or 'nothing'}; valid: a number "
                f"for {name}, or for default"
            )
    # Numbers for tasks that are not in the run stay, as in folders of earlier versions.
    named = {name: number for name, number in given.items() if name != "default"}
    return {name: given.get(name, given.get("default", 0)) for name in recorded} | named


def check_contexts(settings: Settings, tasks: Sequence[Task]) -> None:
    """Raises an error for a run that reads episodes of another behaviour and records none."""
    recorded = any(task.record is not None for task in tasks)
    distill, count = settings.distill, settings.collect.context_episodes
    if recorded and distill.reads_contexts and not count:
        raise ConfigError(
            f"distill.context is {distill.context}, distill.inference_updates "
            f"{distill.inference_updates} and collect.context_episodes 0; valid: at least 1"
        )
