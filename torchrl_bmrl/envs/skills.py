"""Skills: where an episode starts, its goal, its reward and its definition of success.

A :class:`Skill` is a small value. :class:`~torchrl_bmrl.envs.scene.TabletopScene` runs one skill or
several in a row. The six skills of the paper are :data:`SKILLS`; another one is a subclass.

Reference: *Compositional Skill Learning Using Batch Meta RL*, section 3.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from torchrl_bmrl.envs.table import sample_home
from torchrl_bmrl.errors import BMRLError, UnknownNameError

if TYPE_CHECKING:
    from torchrl_bmrl.envs.scene import TabletopScene

PUSH_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "right": (0.0, -1.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "up": (1.0, 0.0, 0.0),
    "down": (-1.0, 0.0, 0.0),
}
"""Unit vectors seen from the robot's base: +x away from it, +y to its left."""

REACH_SUCCESS_DISTANCE = 0.02
LIFT_SUCCESS_HEIGHT = 0.05
PUSH_SUCCESS_DISTANCE = 0.07


def reach_reward(distance: float) -> float:
    r"""Dense reward for the end-effector's distance to the goal.

    .. math:: r = 1 - \tanh(10\, d^2)

    Args:
        distance: d, end-effector to goal [m].

    Example:
        >>> reach_reward(0.0)
        1.0
    """
    return float(1.0 - np.tanh(10.0 * distance**2))


def push_velocity_reward(velocity: np.ndarray, direction: np.ndarray) -> float:
    r"""Dense reward for moving the cube along the target direction.

    .. math:: r = 1 - \tanh(\lVert v - u \rVert)

    Args:
        velocity: v, the cube's linear velocity, shape ``(3,)`` [m/s].
        direction: u, the unit target direction, shape ``(3,)``.
    """
    return float(1.0 - np.tanh(np.linalg.norm(velocity - direction)))


@dataclass(frozen=True)
class Skill:
    """Base class of skills: by default one that acts on the cube and starts above it.

    A skill only reads the scene. Subclasses are frozen dataclasses whose fields are numbers and
    texts, so that worker processes and data files can rebuild them. They define :attr:`name`,
    :attr:`terms`, :meth:`reward_terms` and :meth:`success`.

    Attributes:
        name: unique name: letters, digits and ``_``.
        terms: names of the reward's terms; ``info`` contains ``reward_<term>``.
        has_cube: whether the scene needs the cube.
        has_target: whether the scene draws a random point for it, ``scene.target``.
        holds_cube_after: whether the cube is in the hand after success; ``None``: as before.
        timed: whether it reads ``scene.stage_time`` and ``scene.start_position``, which belong to
            the state of an episode then.

    Example:
        >>> from torchrl_bmrl.envs.tabletop import TabletopEnv
        >>> @dataclass(frozen=True)
        ... class Touch(Skill):
        ...     name = "touch"
        ...     terms = ("reach",)
        ...
        ...     def reward_terms(self, scene):
        ...         return {"reach": self.reach_term(scene)}
        ...
        ...     def success(self, scene):
        ...         return np.linalg.norm(scene.eef_position - scene.cube_position) < 0.03
        >>> env = TabletopEnv(Touch())
        >>> observation, info = env.reset(seed=0)
        >>> env.task, bool(info["success"])
        ('touch', False)
    """

    terms: ClassVar[tuple[str, ...]]
    has_cube: ClassVar[bool] = True
    has_target: ClassVar[bool] = False
    holds_cube_after: ClassVar[bool | None] = None
    timed: ClassVar[bool] = False

    # A plain attribute in most subclasses, a property where fields decide it.
    name: ClassVar[Any]

    def start(self, scene: TabletopScene) -> np.ndarray:
        """End-effector position at the start of an episode, (3,) [m].

        Args:
            scene: with the cube in its place.
        """
        return scene.above_cube

    def begin(self, scene: TabletopScene, following: Skill | None) -> np.ndarray:
        """Position that the episode or stage is measured from, (3,) [m]; the goal marker's place.

        Args:
            scene: as the stage begins.
            following: the next skill of a composition.
        """
        return scene.cube_on_table

    def goal(self, scene: TabletopScene) -> np.ndarray:
        """The observation's ``goal_pos``, (3,) [m].

        Args:
            scene: in its present state.
        """
        return scene.cube_position

    def reach_term(self, scene: TabletopScene) -> float:
        """:func:`reach_reward` of the end-effector's distance to :meth:`goal`.

        Args:
            scene: in its present state.
        """
        return reach_reward(float(np.linalg.norm(scene.eef_position - self.goal(scene))))

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """Values of :attr:`terms`; the reward is their sum.

        Args:
            scene: in its present state.
        """
        raise NotImplementedError

    def success(self, scene: TabletopScene) -> bool:
        """Whether the skill succeeds now.

        Args:
            scene: in its present state.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Reach(Skill):
    """Bring the end-effector to a random point, from within 1 cm of a set point.

    Before a skill on the cube the point is above the cube, unless the cube is in the hand.

    Example:
        >>> Reach().name, Reach().has_cube
        ('reach', False)
    """

    name = "reach"
    terms = ("reach",)
    has_cube = False
    has_target = True

    def start(self, scene: TabletopScene) -> np.ndarray:
        """A random point within 1 cm of the set point."""
        return sample_home(scene.rng)

    def begin(self, scene: TabletopScene, following: Skill | None) -> np.ndarray:
        """The point to reach."""
        to_cube = following is not None and following.has_cube and not scene.carrying
        return scene.above_cube if to_cube else scene.target

    def goal(self, scene: TabletopScene) -> np.ndarray:
        """The point to reach."""
        return scene.goal_start

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to the goal."""
        return {"reach": self.reach_term(scene)}

    def success(self, scene: TabletopScene) -> bool:
        """Within 2 cm of the goal."""
        return bool(np.linalg.norm(scene.eef_position - scene.goal) < REACH_SUCCESS_DISTANCE)


@dataclass(frozen=True)
class Lift(Skill):
    """Grasp the cube from above and lift it more than 5 cm.

    Example:
        >>> Lift().terms
        ('reach', 'grasp', 'lift')
    """

    name = "lift"
    terms = ("reach", "grasp", "lift")
    holds_cube_after = True

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to the cube, the grasp, the height."""
        high = float(scene.cube_displacement[2] > LIFT_SUCCESS_HEIGHT)
        return {"reach": self.reach_term(scene), "grasp": float(scene.grasped), "lift": high}

    def success(self, scene: TabletopScene) -> bool:
        """The cube is grasped and 5 cm above its start."""
        return bool(scene.cube_displacement[2] > LIFT_SUCCESS_HEIGHT) and scene.grasped


@dataclass(frozen=True)
class Push(Skill):
    """Push the cube 7 cm in one of four directions.

    Args:
        side: ``"right"``, ``"left"``, ``"up"`` or ``"down"``, seen from the robot's base.

    Raises:
        UnknownNameError: for another direction.

    Example:
        >>> Push("left").name, Push("left").direction.tolist()
        ('push_left', [0.0, 1.0, 0.0])
    """

    side: str
    terms = ("reach", "velocity", "distance")
    holds_cube_after = False

    def __post_init__(self) -> None:
        if self.side not in PUSH_DIRECTIONS:
            raise UnknownNameError("push direction", self.side, tuple(PUSH_DIRECTIONS))

    @property
    def name(self) -> str:
        """``push_<side>``."""
        return f"push_{self.side}"

    @property
    def direction(self) -> np.ndarray:
        """Unit vector (3,) to push along."""
        return np.array(PUSH_DIRECTIONS[self.side])

    def reward_terms(self, scene: TabletopScene) -> dict[str, float]:
        """The distance to the cube, the cube's velocity, its distance from the start."""
        moved = float(np.linalg.norm(scene.cube_displacement))
        return {
            "reach": self.reach_term(scene),
            "velocity": push_velocity_reward(scene.cube_velocity, self.direction),
            "distance": float(moved > PUSH_SUCCESS_DISTANCE),
        }

    def success(self, scene: TabletopScene) -> bool:
        """The cube moved 7 cm along the direction, and at most half of that sideways."""
        along = float(scene.cube_displacement @ self.direction)
        sideways = float(np.linalg.norm(scene.cube_displacement - along * self.direction))
        return along > PUSH_SUCCESS_DISTANCE and sideways <= PUSH_SUCCESS_DISTANCE / 2


SKILLS: dict[str, Skill] = {
    skill.name: skill for skill in (Reach(), Lift(), *(Push(side) for side in PUSH_DIRECTIONS))
}
"""The six skills of the paper by name."""
REWARD_TERMS = tuple(dict.fromkeys(term for skill in SKILLS.values() for term in skill.terms))
"""Names of their reward terms; ``info["reward_<name>"]`` is 0 where a skill has no such term."""

SkillLike = str | Skill | Mapping[str, Any]
"""A skill, names of :data:`SKILLS` joined by ``-``, or what :func:`describe_skill` returns."""


def make_skills(skills: SkillLike | Sequence[SkillLike]) -> tuple[Skill, ...]:
    """Skills from names, descriptions and values.

    Args:
        skills: one, or several in a row.

    Raises:
        UnknownNameError: for a name that is not one of :data:`SKILLS`.
        BMRLError: for an empty sequence, or a description whose class is not a skill.

    Example:
        >>> [skill.name for skill in make_skills("reach-lift")]
        ['reach', 'lift']
        >>> make_skills([Push("up"), {"skill": "torchrl_bmrl.envs.skills:Push", "side": "down"}])
        (Push(side='up'), Push(side='down'))
    """
    if isinstance(skills, str):
        names = skills.split("-")
        for name in names:
            if name not in SKILLS:
                raise UnknownNameError("task", name, tuple(SKILLS))
        return tuple(SKILLS[name] for name in names)
    if isinstance(skills, Skill):
        return (skills,)
    if isinstance(skills, Mapping):
        fields = dict(skills)
        module, _, name = str(fields.pop("skill", "")).partition(":")
        kind = getattr(importlib.import_module(module), name, None) if module else None
        if not (isinstance(kind, type) and issubclass(kind, Skill)):
            raise BMRLError(f"{module}:{name} is not a Skill; valid: module:Class of a skill")
        return (kind(**fields),)
    if not skills:
        raise BMRLError("a composition has no tasks; valid: at least one")
    return tuple(skill for part in skills for skill in make_skills(part))


def describe_skill(skill: Skill) -> str | dict[str, Any]:
    """A skill as JSON: the name of one of :data:`SKILLS`, or its class and fields.

    Args:
        skill: a skill whose class can be imported.

    Example:
        >>> describe_skill(Push("up"))
        'push_up'
    """
    if SKILLS.get(skill.name) == skill:
        return skill.name
    return {"skill": f"{type(skill).__module__}:{type(skill).__qualname__}", **asdict(skill)}
