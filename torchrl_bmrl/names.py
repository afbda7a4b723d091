"""Names that every part of the library shares: tasks, their order, directions."""

from __future__ import annotations

from torchrl_bmrl.errors import UnknownNameError

PUSH_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "right": (0.0, -1.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "up": (1.0, 0.0, 0.0),
    "down": (-1.0, 0.0, 0.0),
}
"""Unit vectors seen from the robot's base: +x away from it, +y to its left."""

TASKS: tuple[str, ...] = ("reach", "lift", *(f"push_{name}" for name in PUSH_DIRECTIONS))
"""The six tasks; a task's position is its class index ``task``."""

HORIZON = 200
"""Steps of an episode; it ends there by truncation, never by termination."""

STEPPERS = ("fast", "robosuite")
"""Who advances the simulator; the trajectories are the same to the bit."""


def check_task(task: str) -> str:
    """Returns ``task`` if it is one of :data:`TASKS`.

    Raises:
        UnknownNameError: otherwise; the message lists the valid names.

    Example:
        >>> check_task("lift")
        'lift'
    """
    if task not in TASKS:
        raise UnknownNameError("task", task, TASKS)
    return task


def gymnasium_id(task: str) -> str:
    """Registered gymnasium id of a task.

    Example:
        >>> gymnasium_id("push_left")
        'bmrl/SawyerPushLeft-v0'
    """
    return f"bmrl/Sawyer{check_task(task).title().replace('_', '')}-v0"
