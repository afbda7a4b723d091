"""Names that every part of the library shares: tasks and their order."""

from __future__ import annotations

from torchrl_bmrl.errors import UnknownNameError

TASKS = ("reach", "lift", "push_right", "push_left", "push_up", "push_down")
"""The six tasks; a task's position is its class index ``task``."""

HORIZON = 200
"""Steps of an episode; it ends there by truncation, never by termination."""

STAGE_HORIZON = 100
"""Steps that an episode of a composition has for each of its stages."""

STEPPERS = ("fast", "robosuite")
"""Who advances the simulator; the trajectories are the same to the bit."""


def check_task(task: str) -> str:
    """Returns ``task`` if it is one of :data:`TASKS`.

    Args:
        task: a name.

    Raises:
        UnknownNameError: otherwise; the message lists the valid names.

    Example:
        >>> check_task("lift")
        'lift'
    """
    if task not in TASKS:
        raise UnknownNameError("task", task, TASKS)
    return task


def composition_stages(composition: str) -> tuple[str, ...]:
    """The tasks of a composition, in their order; they are joined by ``-``.

    Args:
        composition: such as ``"reach-lift"``; a task alone is a composition of one.

    Raises:
        UnknownNameError: if one of them is not a task.

    Example:
        >>> composition_stages("reach-lift-push_left")
        ('reach', 'lift', 'push_left')
    """
    return tuple(check_task(task) for task in composition.split("-"))


def horizon_of(task: str) -> int:
    """Steps of an episode of a task, or of a composition.

    Args:
        task: one of :data:`TASKS`, or several joined by ``-``.

    Returns:
        :data:`HORIZON` for a task, :data:`STAGE_HORIZON` for each task of a composition.

    Raises:
        UnknownNameError: if one of them is not a task.

    Example:
        >>> horizon_of("lift"), horizon_of("reach-lift-reach")
        (200, 300)
    """
    stages = composition_stages(task)
    return HORIZON if len(stages) == 1 else STAGE_HORIZON * len(stages)
