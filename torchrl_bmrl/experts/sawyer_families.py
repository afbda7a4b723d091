"""Families of Sawyer tasks whose parameter the observation does not show, and their experts.

Importing this module registers ``push_towards``, ``reach_hidden``, ``lift_to_height`` and
``reach_at_speed``; it does not import the simulator.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchrl_bmrl.envs.hidden import (
    CHECKPOINT,
    HIDDEN,
    HIDDEN_HORIZONS,
    LiftToHeight,
    PushTowards,
    ReachAtSpeed,
)
from torchrl_bmrl.envs.table import CONTROL_FREQUENCY, TABLE_TOP
from torchrl_bmrl.experts.controllers import (
    EXPERTS,
    Expert,
    LiftExpert,
    ReachExpert,
)
from torchrl_bmrl.experts.tabletop import make_task
from torchrl_bmrl.families import Family, register_family
from torchrl_bmrl.tasks import Task

LEAD = 0.12
"""The expert aims at where the end-effector should be in this time, since the arm lags [s]."""
STEER = 3.0
"""How many times its distance from the line the cube is sent back towards it."""
HOVER = 0.01
"""Height above the table at which the cube is moved [m]."""


def straight(delta: np.ndarray, limit: float) -> np.ndarray:
    """Limits the length of a position action, not each of its numbers: its direction stays.

    Args:
        delta: position action (3,).
        limit: largest length.

    Example:
        >>> straight(np.array([0.0, 4.0, 0.0]), 0.5).tolist()
        [0.0, 0.5, 0.0]
    """
    return delta * min(1.0, limit / max(float(np.linalg.norm(delta)), 1e-9))


class PushTowardsExpert(LiftExpert):
    """Takes the cube between the fingers and moves it over a line across the skill's direction.

    Closed fingers that push from outside slip off in the diagonals. The cube hovers closely above
    the table, whose friction would turn the arm aside.
    """

    phases = ("descend", "grasp", "push")

    def _gain(self) -> float:
        return self.gains.position if self.phase == 2 else self.gains.grasp_position

    def _lost(self, cube: np.ndarray) -> bool:
        return bool(np.linalg.norm(self.env.eef_position - cube) > 0.03)

    def _carry(self, cube: np.ndarray) -> np.ndarray:
        """Ahead of the cube until it is over the line."""
        assert isinstance(self.skill, PushTowards)
        unit = self.skill.unit
        ahead = min(0.10, max(0.0, self.gains.push_line - float(cube @ unit)))
        # Along the line through the cube's start, since the arm drifts sideways.
        start = self.env.goal_start
        aside = cube - start - ((cube - start) @ unit) * unit
        target = cube + ahead * unit - STEER * aside
        target[2] = self.env.goal_start[2] + HOVER
        return target

    def _limited(self, delta: np.ndarray, limit: float) -> np.ndarray:
        return straight(delta, limit)


class ReachHiddenExpert(ReachExpert):
    """Moves straight to the point, which it knows."""

    def _goal(self) -> np.ndarray:
        return self.skill.begin(self.env, None)


class LiftToHeightExpert(LiftExpert):
    """Lifts the cube to the skill's height."""

    def _height(self) -> float:
        assert isinstance(self.skill, LiftToHeight)
        return self.skill.height / 100


class ReachAtSpeedExpert(ReachExpert):
    """Follows the point that moves to the goal at the skill's speed."""

    def _goal(self) -> np.ndarray:
        assert isinstance(self.skill, ReachAtSpeed)
        return self.skill.pacemaker(self.env, ahead=LEAD)

    def _limited(self, delta: np.ndarray, limit: float) -> np.ndarray:
        return straight(delta, limit)


HIDDEN_EXPERTS: dict[str, type[Expert]] = {
    "push_towards": PushTowardsExpert,
    "reach_hidden": ReachHiddenExpert,
    "lift_to_height": LiftToHeightExpert,
    "reach_at_speed": ReachAtSpeedExpert,
}
"""Experts by the name of the family."""
EXPERTS.update({HIDDEN[name]: expert for name, expert in HIDDEN_EXPERTS.items()})


def make_member(family: str, *parameter: float) -> Task:
    """Returns a member of one of this module's families, with any parameter.

    Args:
        family: a key of :data:`HIDDEN_EXPERTS`.
        *parameter: fields of the family's skill (:mod:`torchrl_bmrl.envs.hidden`).

    Example:
        >>> make_member("push_towards", 45).name
        'push_towards_45'
    """
    skill = HIDDEN[family](*parameter)
    return make_task(skill, HIDDEN_EXPERTS[family], horizon=HIDDEN_HORIZONS[family])


def _points(number: int, low: tuple[int, ...], high: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Whole points that fill a box evenly: multiples of the generalised golden ratio."""
    ratio = 1.22074408460575947536  # the real root of x^4 = x + 1
    steps = ratio ** -np.arange(1, len(low) + 1)
    share = (0.5 + np.arange(1, number + 1)[:, None] * steps) % 1
    points = np.round(np.array(low) + share * (np.array(high) - low)).astype(int)
    return [tuple(point) for point in points.tolist()]


def _circle(direction: float) -> tuple[float, float]:
    angle = np.deg2rad(direction)
    return float(np.cos(angle)), float(np.sin(angle))


def _end_effector(observation: Tensor) -> Tensor:
    return observation[:, -10:-7]  # OBSERVATION_PARTS ends with it, a quaternion and goal_pos


def pushed_direction(observation: Tensor) -> tuple[float]:
    """Direction from the cube's first to its last position [°].

    Args:
        observation: of an episode, ``(T, obs_dim)``.
    """
    x, y, _ = (observation[-1, -3:] - observation[0, -3:]).tolist()
    return (math.degrees(math.atan2(y, x)) % 360,)


def lifted_height(observation: Tensor) -> tuple[float]:
    """Height of the cube above its start, mean over the last ten steps [cm].

    Args:
        observation: of an episode, ``(T, obs_dim)``.
    """
    return (100 * float(observation[-10:, -1].mean() - observation[0, -1]),)


def reached_point(observation: Tensor) -> tuple[float, ...]:
    """Last position of the end-effector, relative to the table's centre [cm].

    Args:
        observation: of an episode, ``(T, obs_dim)``.
    """
    centre = torch.as_tensor(TABLE_TOP, dtype=observation.dtype)
    return tuple((100 * (_end_effector(observation)[-1] - centre)).tolist())


def moved_speed(observation: Tensor) -> tuple[float]:
    """Mean speed of the end-effector over the first three quarters of its way [mm/s].

    Args:
        observation: of an episode, ``(T, obs_dim)``.
    """
    way = (_end_effector(observation) - _end_effector(observation)[0]).norm(dim=-1)
    most = CHECKPOINT * float(way[-1])
    steps = max(1, int((way >= most).nonzero()[0]))
    return (1000 * most * CONTROL_FREQUENCY / steps,)


_POINTS = _points(24, (-12, -20, 6), (12, 20, 32))

register_family(
    Family(
        name="push_towards",
        parameters=("direction [°]",),
        members={
            "train": [(angle,) for angle in range(0, 281, 40)],
            "inside": [(angle,) for angle in range(20, 280, 40)],
            "outside": [(angle,) for angle in (300, 310, 320, 330, 340)],
        },
        make=partial(make_member, "push_towards"),
        measure=pushed_direction,
        code=_circle,
        period=360,
    )
)
register_family(
    Family(
        name="reach_hidden",
        parameters=("x [cm]", "y [cm]", "z [cm]"),
        members={
            "train": _POINTS,
            "inside": _points(8, (-9, -15, 10), (9, 15, 28)),
            "outside": [(0, 26, 20), (0, -26, 20), (0, 0, 38), (16, 20, 20), (-14, -24, 30)],
        },
        make=partial(make_member, "reach_hidden"),
        measure=reached_point,
    )
)
register_family(
    Family(
        name="lift_to_height",
        parameters=("height [cm]",),
        members={
            "train": [(height,) for height in range(6, 21, 2)],
            "inside": [(height,) for height in range(7, 20, 2)],
            "outside": [(4,), (22,), (24,), (26,)],
        },
        make=partial(make_member, "lift_to_height"),
        measure=lifted_height,
    )
)
register_family(
    Family(
        name="reach_at_speed",
        parameters=("speed [mm/s]",),
        members={
            "train": [(speed,) for speed in range(30, 121, 10)],
            "inside": [(speed,) for speed in range(35, 120, 10)],
            "outside": [(20,), (25,), (130,), (140,), (150,)],
        },
        make=partial(make_member, "reach_at_speed"),
        measure=moved_speed,
    )
)
