"""Skills with a parameter that the observation does not show: the members of families.

Two skills of one class have equal observations in equal states; only rewards, and what an expert
does, tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_bmrl.envs.skills import (
    PUSH_SUCCESS_DISTANCE,
    REACH_SUCCESS_DISTANCE,
    Skill,
    push_velocity_reward,
    reach_reward,
)
from torchrl_bmrl.envs.table import TABLE_TOP, sample_home
from torchrl_bmrl.errors import BMRLError

if TYPE_CHECKING:
    from torchrl_bmrl.envs.scene import TabletopScene

HEIGHT_TOLERANCE = 0.015
STILL = 0.03
"""A lifted cube that is slower than this is held still [m/s]."""
PRECISION = 5.0
"""Distances to a hidden height or pace count this many times as much as in ``reach``."""
CHECKPOINT = 0.75
"""Share of the way at which the pace decides the success of :class:`ReachAtSpeed`."""


class _Hidden(Skill):
    """A skill whose name ends with its parameters."""

    stem: Any

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise BMRLError(f"{each.name} of {self.stem} is {value!r}; valid: a number")
            if not np.isfinite(value):
                raise BMRLError(f"{each.name} of {self.stem} is {value}; valid: a finite number")

    @property
    def name(self) -> str:
        """The stem and the parameters; ``m`` is a minus sign."""
        values = (f"{getattr(self, each.name):g}" for each in fields(self))
        return "_".join([self.stem, *values]).replace("-", "m").replace("+", "")


@dataclass(frozen=True)
class PushTowards(_Hidden):
    """Move the cube 7 cm along the table in any direction.

    Args:
        direction: counter-clockwise from above [°]: 0 is away from the robot's base, 90 its left.

    Raises:
        BMRLError: for anything but a finite number.

    Example:
        >>> PushTowards(45).name, PushTowards(90).unit.round(3).tolist()
        ('push_towards_45', [0.0, 1.0, 0.0])
    """

    direction: float
    stem = "push_towards"
    terms = ("reach", "velocity", "along")

    @property
    def unit(self) -> np.ndarray:
        """Unit vector (3,) to push along."""
        angle = np.deg2rad(self.direction)
        return np.array([np.cos(angle), np.sin(angle), 0.0])

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to the cube, the cube's velocity, whether it is where it should be."""
        return {
            "reach": self.reach_term(scene),
            "velocity": push_velocity_reward(scene.cube_velocity, self.unit),
            "along": float(self.success(scene)),
        }

    def success(self, scene: TabletopScene) -> bool:
        """The cube moved 7 cm along the direction, and at most a third as far sideways."""
        along = float(scene.cube_displacement @ self.unit)
        sideways = float(np.linalg.norm(scene.cube_displacement - along * self.unit))
        return along > PUSH_SUCCESS_DISTANCE and sideways <= along / 3


@dataclass(frozen=True)
class ReachHidden(_Hidden):
    """Bring the end-effector to a point that ``goal_pos`` does not show.

    ``goal_pos`` is the end-effector's own position.

    Args:
        x, y, z: the point, relative to the centre of the table's surface [cm].

    Raises:
        BMRLError: for anything but finite numbers.

    Example:
        >>> ReachHidden(-5, 10, 20).name
        'reach_hidden_m5_10_20'
    """

    x: float
    y: float
    z: float
    stem = "reach_hidden"
    terms = ("reach",)
    has_cube = False

    def start(self, scene: TabletopScene) -> np.ndarray:
        """A random point within 1 cm of the set point."""
        return sample_home(scene.rng)

    def begin(self, scene: TabletopScene, following: Skill | None) -> np.ndarray:
        """The point to reach."""
        return TABLE_TOP + np.array([self.x, self.y, self.z]) / 100

    def goal(self, scene: TabletopScene) -> np.ndarray:
        """The end-effector's position, which says nothing about the point."""
        return scene.eef_position

    def distance(self, scene: TabletopScene) -> float:
        """End-effector to the point [m]."""
        return float(np.linalg.norm(scene.eef_position - scene.goal_start))

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to the point."""
        return {"reach": reach_reward(self.distance(scene))}

    def success(self, scene: TabletopScene) -> bool:
        """Within 2 cm of the point."""
        return self.distance(scene) < REACH_SUCCESS_DISTANCE


@dataclass(frozen=True)
class LiftToHeight(_Hidden):
    """Grasp the cube from above, lift it to a height and hold it there.

    Args:
        height: of the cube above its start [cm].

    Raises:
        BMRLError: for anything but a finite number.

    Example:
        >>> LiftToHeight(12).name
        'lift_to_height_12'
    """

    height: float
    stem = "lift_to_height"
    terms = ("reach", "grasp", "height")
    holds_cube_after = True

    def error(self, scene: TabletopScene) -> float:
        """Distance of the cube from its height [m]."""
        return abs(float(scene.cube_displacement[2]) - self.height / 100)

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to the cube, the grasp, and the height of the grasped cube."""
        grasped = float(scene.grasped)
        near = reach_reward(PRECISION * self.error(scene))
        return {"reach": self.reach_term(scene), "grasp": grasped, "height": grasped * near}

    def success(self, scene: TabletopScene) -> bool:
        """The cube is grasped, within 1.5 cm of its height and slower than 3 cm/s."""
        still = float(np.linalg.norm(scene.cube_velocity)) < STILL
        return scene.grasped and still and self.error(scene) < HEIGHT_TOLERANCE


@dataclass(frozen=True)
class ReachAtSpeed(_Hidden):
    """Bring the end-effector to the random point of ``goal_pos`` in a straight line, at a speed.

    The reward compares the end-effector with a point that moves from its start to the goal.

    Args:
        speed: of that point [mm/s].

    Raises:
        BMRLError: for anything but a finite number above 0.

    Example:
        >>> ReachAtSpeed(80).name
        'reach_at_speed_80'
    """

    speed: float
    stem = "reach_at_speed"
    terms = ("pace",)
    has_cube = False
    has_target = True
    timed = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speed <= 0:
            raise BMRLError(f"speed of {self.stem} is {self.speed}; valid: above 0")

    def start(self, scene: TabletopScene) -> np.ndarray:
        """A random point within 1 cm of the set point."""
        return sample_home(scene.rng)

    def begin(self, scene: TabletopScene, following: Skill | None) -> np.ndarray:
        """The point to reach."""
        return scene.target

    def goal(self, scene: TabletopScene) -> np.ndarray:
        """The point to reach."""
        return scene.goal_start

    def share(self, scene: TabletopScene, ahead: float = 0.0) -> float:
        """Share of the way that should be over; more than 1 after the arrival.

        Args:
            scene: in its present state.
            ahead: so much later than now [s].
        """
        way = float(np.linalg.norm(scene.goal_start - scene.start_position))
        return (scene.stage_time + ahead) * self.speed / 1000 / max(way, 1e-6)

    def pacemaker(self, scene: TabletopScene, ahead: float = 0.0) -> np.ndarray:
        """Where the end-effector should be, (3,) [m].

        Args:
            scene: in its present state.
            ahead: so much later than now [s].
        """
        start, goal = scene.start_position, scene.goal_start
        return start + min(1.0, self.share(scene, ahead)) * (goal - start)

    def distance(self, scene: TabletopScene) -> float:
        """End-effector to where it should be [m]."""
        return float(np.linalg.norm(scene.eef_position - self.pacemaker(scene)))

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to where the end-effector should be."""
        return {"pace": reach_reward(PRECISION * self.distance(scene))}

    def success(self, scene: TabletopScene) -> bool:
        """Within 2 cm of where it should be, in the step in which 75% of the way are over."""
        before = self.share(scene, -scene.control_timestep)
        now = before < CHECKPOINT <= self.share(scene)
        return now and self.distance(scene) < REACH_SUCCESS_DISTANCE


HIDDEN: dict[str, type[_Hidden]] = {
    kind.stem: kind for kind in (PushTowards, ReachHidden, LiftToHeight, ReachAtSpeed)
}
"""The classes by the name of their family."""
HIDDEN_HORIZONS = {
    "push_towards": 100,
    "reach_hidden": 100,
    "lift_to_height": 100,
    "reach_at_speed": 200,
}
"""Steps of an episode by the name of the family: little more than the slowest member needs."""
