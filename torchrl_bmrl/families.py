"""Families: tasks that differ in a parameter which the observation does not show.

:func:`register_family` gives a :class:`Family` a name that settings accept in place of its trained
members.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.tasks import (
    FAMILIES,
    NAME,
    Task,
    get_task,
    import_module_of,
    register_own_tasks,
)

if TYPE_CHECKING:
    from torch import Tensor

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
        >>> from torchrl_bmrl.tasks import DemonstrationFiles
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
        if not NAME.fullmatch(self.name):
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

    @cached_property
    def by_name(self) -> dict[str, tuple[float, ...]]:
        """Parameter of each member by the name of its task."""
        return {self.make(*parameter).name: parameter for parameter in self.all()}

    def parameter(self, task: str) -> tuple[float, ...]:
        """Parameter of a member.

        Args:
            task: the name of the member's task.

        Raises:
            UnknownNameError: if no member has that name.
        """
        if task not in self.by_name:
            raise UnknownNameError(f"member of family {self.name}", task, tuple(self.by_name))
        return self.by_name[task]

    @property
    def repeats(self) -> tuple[float, ...] | None:
        """After which each number of :meth:`told` means the same again; ``None``: never."""
        if self.period is None or self.code is not None:
            return None
        columns = zip(*self.members["train"], strict=True)
        return tuple(2 * self.period / ((max(x) - min(x)) or 1) for x in columns)

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
    FAMILIES[family.name] = family
    return family


def registered_families() -> tuple[str, ...]:
    """Names of the registered families, in the order of registration.

    Example:
        >>> registered_families()[:2]
        ('push_towards', 'reach_hidden')
    """
    register_own_tasks()
    return tuple(FAMILIES)


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
    rest = import_module_of("family", name)
    known = registered_families()
    if rest not in known:
        raise UnknownNameError("family", rest, known)
    return FAMILIES[rest]


def find_family(chosen: Sequence[str], names: Sequence[str]) -> Family:
    """The family whose trained members are the tasks of a run.

    Args:
        chosen: the names that the run's settings give; the name of a family decides.
        names: of the run's tasks.

    Raises:
        ConfigError: if the tasks are not those of one family, or those of several.

    Example:
        >>> find_family(["push_towards"], []).title
        'Push towards'
    """
    known = registered_families()
    if len(chosen) == 1 and (name := chosen[0].rpartition(":")[2]) in known:
        return FAMILIES[name]
    found = [x for x in known if [task.name for task in FAMILIES[x].tasks("train")] == list(names)]
    if len(found) == 1:
        return FAMILIES[found[0]]
    those = " or ".join(f"tasks=[{name}]" for name in found or known[:1])
    raise ConfigError(
        f"tasks is {', '.join(names)}; valid: the trained members of one family, such as {those}"
    )


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
    rest = import_module_of("task", name)
    if rest in registered_families():
        return FAMILIES[rest].tasks("train")
    return (get_task(name),)
