"""Tasks: where demonstrations come from, how the environment is made, how a task is shown.

A :class:`Task` is a value. :func:`register_task` gives it a name that settings, recipes and
:func:`get_task` accept. The six Sawyer tasks of this package register themselves the same way.

A :class:`Family` is a set of tasks that differ in a parameter which the observation does not show.
:func:`register_family` gives it a name that settings accept in place of its trained members.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from torchrl_bmrl.errors import ConfigError, UnknownNameError

if TYPE_CHECKING:
    from torch import Tensor
    from torchrl.envs import EnvBase
    from torchrl.envs.transforms import Transform

    from torchrl_bmrl.data.episodes import Episode

OWN_TASKS = (
    "torchrl_bmrl.experts.tabletop",
    "torchrl_bmrl.experts.sawyer_families",
    "torchrl_bmrl.experts.metaworld",
)
"""Modules that register this package's own tasks; they are imported when a name is looked up."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.]*")


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
            :class:`~torchrl_bmrl.data.Episode` of a scripted expert.
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
    compose: Callable[[Sequence[Task]], Task] | None = None

    def __post_init__(self) -> None:
        parts = self.stages if self.compose else (self.name,)
        if not all(_NAME.fullmatch(part) for part in parts):
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


SPLITS = ("train", "inside", "outside")
"""Trained members of a family; members held out within the trained range; and beyond it."""


@dataclass(frozen=True, kw_only=True)
class Family:
    """Tasks that differ in a parameter which the observation does not show.

    Attributes:
        name: letters, digits, ``_`` and ``.``.
        parameters: name and unit of each number of a member's parameter, for tables and figures.
        members: the parameters of the members, one tuple of numbers each, by split: ``"train"``,
            ``"inside"`` (held out, within the trained range) and ``"outside"`` (held out, beyond
            it).
        make: ``make(*parameter)`` returns a member's :class:`Task`; equal parameters give equal
            names.
        code: ``code(*parameter)`` returns the numbers that a policy is given which is told the
            parameter; ``None``: the parameter, scaled to [-1, 1] over the trained members.
        period: after which a parameter repeats, such as 360 for a direction; ``None``: never.
        measure: returns the parameter that an episode looks like, from its observations
            ``(T, obs_dim)``, not normalised; ``None``: the family has no such measure.
        title: name in tables and figures; by default the name with spaces for underscores.

    Raises:
        ConfigError: for a name that is not valid, a missing split or no trained member, a
            parameter of another length, or the same parameter twice.

    Example:
        >>> def make(angle):
        ...     return Task(name=f"turn_{angle}", files=DemonstrationFiles(path=f"{angle}.hdf5"))
        >>> members = {"train": [(0,), (90,)], "inside": [(45,)], "outside": [(120,)]}
        >>> family = Family(name="turn", parameters=("angle [°]",), members=members, make=make)
        >>> [task.name for task in family.tasks("train")], family.told("turn_45")
        (['turn_0', 'turn_90'], (0.0,))
    """

    name: str
    parameters: tuple[str, ...]
    members: Mapping[str, Sequence[tuple[float, ...]]]
    make: Callable[..., Task]
    code: Callable[..., tuple[float, ...]] | None = None
    period: float | None = None
    measure: Callable[[Tensor], tuple[float, ...]] | None = None
    title: str = ""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ConfigError(f"a family's name is {self.name!r}; valid: letters, digits, _ and .")
        if tuple(self.members) != SPLITS or not self.members["train"]:
            raise ConfigError(
                f"members of family {self.name} are {', '.join(self.members) or 'missing'}; valid: "
                f"{', '.join(SPLITS)}, in this order, with at least one in train"
            )
        size = len(self.parameters)
        for parameter in self.all():
            if len(parameter) != size:
                raise ConfigError(
                    f"a member of family {self.name} is {parameter}; valid: {size} numbers"
                )
        if len(set(self.all())) < len(self.all()):
            twice = next(x for i, x in enumerate(self.all()) if x in self.all()[:i])
            raise ConfigError(
                f"members of family {self.name} contain {twice} twice; valid: each parameter once, "
                "in one split"
            )
        if not self.title:
            object.__setattr__(self, "title", self.name.replace("_", " ").capitalize())

    def all(self) -> list[tuple[float, ...]]:
        """Parameters of all members."""
        return [tuple(parameter) for split in SPLITS for parameter in self.members[split]]

    def tasks(self, split: str) -> tuple[Task, ...]:
        """Tasks of the members of one split.

        Args:
            split: one of :data:`SPLITS`.

        Raises:
            UnknownNameError: for another split.
        """
        if split not in SPLITS:
            raise UnknownNameError("split of a family", split, SPLITS)
        return tuple(self.make(*parameter) for parameter in self.members[split])

    def parameter(self, task: str) -> tuple[float, ...]:
        """Parameter of a member.

        Args:
            task: the name of the member's task.

        Raises:
            UnknownNameError: if no member has that name.
        """
        names = {self.make(*parameter).name: parameter for parameter in self.all()}
        if task not in names:
            raise UnknownNameError(f"member of family {self.name}", task, tuple(names))
        return names[task]

    def told(self, task: str) -> tuple[float, ...]:
        """Numbers that a policy is given which is told a member's parameter.

        Args:
            task: the name of the member's task.
        """
        parameter = self.parameter(task)
        if self.code is not None:
            return self.code(*parameter)
        columns = zip(parameter, *self.members["train"], strict=True)
        return tuple(
            (2 * value - min(trained) - max(trained)) / ((max(trained) - min(trained)) or 1)
            for value, *trained in columns
        )


_registry: dict[str, Task] = {}
_families: dict[str, Family] = {}


def _register_own() -> None:
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


def register_family(family: Family) -> Family:
    """Makes a family and its members known by name; a later family of the same name replaces it.

    Args:
        family: the family.

    Returns:
        the same family.

    Example:
        >>> get_family("push_towards").parameters
        ('direction [°]',)
    """
    _families[family.name] = family
    return family


def registered_families() -> tuple[str, ...]:
    """Names of the registered families, in the order of registration.

    Example:
        >>> registered_families()[:2]
        ('push_towards', 'reach_hidden')
    """
    _register_own()
    return tuple(_families)


def get_family(name: str) -> Family:
    """The family of a name.

    Args:
        name: a registered name; or ``"module:name"``, where importing the module registers it.

    Raises:
        UnknownNameError: if no such family is registered.
        ConfigError: if the module cannot be imported.

    Example:
        >>> len(get_family("push_towards").tasks("inside"))
        9
    """
    rest = _imported("family", name)
    known = registered_families()
    if rest not in known:
        raise UnknownNameError("family", rest, known)
    return _families[rest]


def tasks_of(name: str) -> tuple[Task, ...]:
    """The task of a name, or the trained members of a family.

    Args:
        name: as for :func:`get_task`, or for :func:`get_family`.

    Raises:
        UnknownNameError: if there is neither such a task nor such a family.
        ConfigError: as :func:`get_task`.

    Example:
        >>> [task.name for task in tasks_of("push_towards")][:2]
        ['push_towards_0', 'push_towards_30']
    """
    rest = _imported("task", name)
    if rest in registered_families():
        return _families[rest].tasks("train")
    return (get_task(name),)


def registered_tasks() -> tuple[str, ...]:
    """Names of the registered tasks, in the order of registration; not those of families' members.

    Example:
        >>> registered_tasks()[:3]
        ('reach', 'lift', 'push_right')
    """
    _register_own()
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
    rest = _imported("task", name)
    known = registered_tasks()
    parts = [rest] if rest in known else rest.split("-")
    tasks = {part: _registry.get(part) or _member(part) for part in parts}
    for part, task in tasks.items():
        if task is None:
            raise UnknownNameError("task", part, (*known, *registered_families()))
    return compose_tasks([task for part in parts if (task := tasks[part]) is not None])


def _imported(what: str, name: str) -> str:
    """Imports the module of ``module:name``; returns the name."""
    module, colon, rest = name.rpartition(":")
    if colon:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ConfigError(f"{what} {name}: {module} cannot be imported ({error})") from error
    return rest


def _member(name: str) -> Task | None:
    """Returns the member of a family by its name, if there is one."""
    for family in _families.values():
        if name.startswith(family.name):
            for parameter in family.all():
                if (task := family.make(*parameter)).name == name:
                    return task
    return None


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
