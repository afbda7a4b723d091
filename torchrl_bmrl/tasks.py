"""Tasks: where demonstrations come from, how the environment is made, how a task is shown.

A :class:`Task` is a value. :func:`register_task` gives it a name that settings, recipes and
:func:`get_task` accept. The six Sawyer tasks of this package register themselves the same way.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from torchrl_bmrl.errors import ConfigError, UnknownNameError

if TYPE_CHECKING:
    from torchrl.envs import EnvBase
    from torchrl.envs.transforms import Transform

    from torchrl_bmrl.data.episodes import Episode

OWN_TASKS = (
    "torchrl_bmrl.experts.tabletop",
    "torchrl_bmrl.experts.sawyer_families",
    "torchrl_bmrl.experts.metaworld",
)
"""Modules that register this package's own tasks; they are imported when a name is looked up."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.]*")


@dataclass(frozen=True, kw_only=True)
class DemonstrationFiles:
    """Demonstrations that were recorded elsewhere.

    Attributes:
        path: a file or folder in any layout that :mod:`torchrl_bmrl.data` reads.
        read: options of :class:`~torchrl_bmrl.data.ReadOptions` by name.
        valid_share: share of the episodes that is held out, if the file has no masks of its own.

    Example:
        >>> DemonstrationFiles(path="door.hdf5", read={"reward": "success"}).valid_share
        0.1
    """

    path: str
    read: Mapping[str, Any] = field(default_factory=dict)
    valid_share: float = 0.1


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task that the two stages can be run on.

    Demonstrations come from ``record`` or from ``files``; exactly one of them is given. A task
    without ``make_env`` is trained and judged on held-out demonstrations alone. Worker processes
    receive tasks by pickle: functions must be importable by name.

    Attributes:
        name: letters, digits, ``_`` and ``.``; it names files and columns.
        make_env: ``make_env(num_envs=None, **options)`` returns a TorchRL environment with the
            named parts of the observation, batch ``[]`` or ``[num_envs]``.
        record: ``record(seed, noise=..., gains=..., after=..., **options)`` returns an
            :class:`~torchrl_bmrl.data.Episode` of a scripted expert. With ``like=...``, tasks of
            the same kind, their experts act instead; context episodes need it.
        files: demonstrations that were recorded elsewhere, and how to read them.
        parts: names of the observation's parts in demonstrations and environment; ``None``: all
            parts of the demonstrations.
        observation: returns the transforms that make ``observation`` of the parts, for stored data
            and environments alike; ``None``: the parts are concatenated.
        options: keyword arguments of ``make_env`` and ``record``. Settings may override them.
        horizon: steps after which an episode is truncated; ``None``: the longest demonstration.
        success: key of the environment's ``info`` that tells success; ``None``: the task has no
            definition of success, and tables show returns alone.
        title: name in tables and figures; by default the name with spaces for underscores.
        simulator: module that environments and experts import at their first use; worker processes
            share it.
        compose: makes the task of several tasks in a row, for names such as ``"reach-lift"``.

    Raises:
        ConfigError: for a name that is not valid, or without a source of demonstrations.

    Example:
        >>> task = Task(name="open_door", files=DemonstrationFiles(path="door.hdf5"))
        >>> task.title
        'Open door'
    """

    name: str
    make_env: Callable[..., EnvBase] | None = None
    record: Callable[..., Episode] | None = None
    files: DemonstrationFiles | None = None
    parts: tuple[str, ...] | None = None
    observation: Callable[[], list[Transform]] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    horizon: int | None = None
    success: str | None = None
    title: str = ""
    simulator: str | None = None
    compose: Callable[[Sequence[Task]], Task] | None = None

    def __post_init__(self) -> None:
        parts = self.stages if self.compose else (self.name,)
        if not all(NAME.fullmatch(part) for part in parts):
            raise ConfigError(f"a task's name is {self.name!r}; valid: letters, digits, _ and .")
        if (self.record is None) == (self.files is None):
            raise ConfigError(f"task {self.name} needs demonstrations; valid: record or files")
        horizon = self.horizon
        if horizon is not None and (not isinstance(horizon, int) or horizon < 1):
            raise ConfigError(
                f"horizon of task {self.name} is {horizon}; valid: a whole number above 0"
            )
        if not self.title:
            object.__setattr__(self, "title", self.name.replace("_", " ").capitalize())

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the tasks that a composition does one after the other; its own for one task."""
        return tuple(self.name.split("-"))

    def with_options(self, **options: Any) -> Task:
        """This task with some of its options replaced.

        Args:
            **options: by name; the task must have each of them.

        Raises:
            UnknownNameError: for an option that the task does not have.
        """
        for name in options:
            if name not in self.options:
                raise UnknownNameError(f"option of task {self.name}", name, tuple(self.options))
        return replace(self, options={**self.options, **options})


_registry: dict[str, Task] = {}
FAMILIES: dict[str, Any] = {}
"""Registered families by name; :mod:`torchrl_bmrl.families` imports this module."""


def register_own_tasks() -> None:
    """Imports the modules that register this package's own tasks and families."""
    for module in OWN_TASKS:
        importlib.import_module(module)


def register_task(task: Task) -> Task:
    """Makes a task known by its name; a later task of the same name replaces it.

    Args:
        task: the task.

    Returns:
        the same task.

    Example:
        >>> task = Task(name="my_door", files=DemonstrationFiles(path="door.hdf5"))
        >>> register_task(task) is get_task("my_door")
        True
    """
    _registry[task.name] = task
    return task


def registered_tasks() -> tuple[str, ...]:
    """Names of the registered tasks, in the order of registration; not those of families' members.

    Example:
        >>> registered_tasks()[:3]
        ('reach', 'lift', 'push_right')
    """
    register_own_tasks()
    return tuple(_registry)


def get_task(name: str) -> Task:
    """The task of a name.

    Args:
        name: a registered name; ``"module:name"``, where importing the module registers the name;
            or several names joined by ``-``, which are done one after the other in one episode.

    Raises:
        UnknownNameError: if no such task is registered.
        ConfigError: if the module cannot be imported, or the tasks cannot be composed.

    Example:
        >>> get_task("push_left").title
        'Push left'
        >>> get_task("reach-lift-reach").horizon
        300
    """
    rest = import_module_of("task", name)
    known = registered_tasks()
    parts = [rest] if rest in known else rest.split("-")
    return compose_tasks([_find(part, known) for part in parts])


def _find(name: str, known: tuple[str, ...]) -> Task:
    """Returns the task or the member of a family with a name."""
    if name in known:
        return _registry[name]
    for family in FAMILIES.values():
        if name in family.by_name:
            return family.make(*family.by_name[name])
    raise UnknownNameError("task", name, (*known, *FAMILIES))


def import_module_of(what: str, name: str) -> str:
    """Imports the module of ``module:name``; returns the name.

    Args:
        what: what has the name, for the message.
        name: with or without a module.

    Raises:
        ConfigError: if the module cannot be imported.

    Example:
        >>> import_module_of("task", "torchrl_bmrl.experts.tabletop:lift")
        'lift'
    """
    module, colon, rest = name.rpartition(":")
    if colon:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ConfigError(f"{what} {name}: {module} cannot be imported ({error})") from error
    return rest


def compose_tasks(tasks: Sequence[Task]) -> Task:
    """The task of several tasks that are done one after the other in one episode.

    Args:
        tasks: in their order; a single task is returned as it is.

    Returns:
        a task whose name is theirs, joined by ``-``.

    Raises:
        ConfigError: if the tasks cannot follow each other.

    Example:
        >>> compose_tasks([get_task("reach"), get_task("lift")]).stages
        ('reach', 'lift')
    """
    if len(tasks) == 1:
        return tasks[0]
    compose = tasks[0].compose
    if compose is None or any(task.compose != compose for task in tasks):
        names = ", ".join(task.name for task in tasks)
        raise ConfigError(f"the tasks {names} cannot follow each other in one episode")
    return replace(compose(tasks), name="-".join(task.name for task in tasks))
