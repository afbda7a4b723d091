"""Scripted experts: proportional controllers that read the simulator's state.

An expert goes through a few named phases. Apart from the phase, its actions depend only on the
policy's observation, so that a policy can learn them. Experts use poses and not joints, so that
they control every arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from torchrl_bmrl.envs.rotations import rotation_error
from torchrl_bmrl.envs.skills import Lift, Push, Reach, Skill
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.run.settings import setting

if TYPE_CHECKING:
    from torchrl_bmrl.envs.scene import TabletopScene

POSITION_SCALE = 0.05
"""Position delta of an action of 1 [m]."""
ROTATION_SCALE = 0.5
"""Rotation delta of an action of 1 [rad]."""
OPEN, CLOSE = -1.0, 1.0
RELEASE_MARGIN = 0.003
"""Fingers closer than this to their open gap have released the cube [m]."""


@dataclass(kw_only=True)
class ExpertGains:
    """Gains and limits of the scripted experts.

    Attributes:
        position: commanded position delta as a multiple of the position error.
        grasp_position: the same for lifting. A stiff expert rarely leaves its path, so that a
            policy that imitates it does not learn to return.
        rotation: commanded rotation delta as a multiple of the rotation error.
        speed_limit: largest position action in free motion, in (0, 1].
        contact_speed_limit: largest position action while descending to the cube and while
            pushing it, in (0, 1]. At full speed the arm drifts sideways.
        grasp_steps: smallest number of steps for closing; most grippers need 10 from fully open.
        lift_height: height above the start to which the cube is lifted [m].
        push_line: distance of the final position from the table's centre, along the pushing
            direction [m]. A distance from the cube's start could not be learned, since the policy
            does not observe that start.

    Example:
        >>> gains = ExpertGains(speed_limit=0.5)
        >>> gains.speed_limit, gains.position
        (0.5, 4.0)
    """

    position: float = setting(4.0, at_least=0)
    grasp_position: float = setting(1.5, at_least=0)
    rotation: float = setting(1.0, at_least=0)
    speed_limit: float = setting(1.0, above=0, at_most=1)
    contact_speed_limit: float = setting(0.7, above=0, at_most=1)
    grasp_steps: int = setting(10, at_least=0)
    lift_height: float = setting(0.10, at_least=0)
    push_line: float = setting(0.20, at_least=0)


class Expert:
    """A scripted controller for one skill of a running scene.

    Subclasses define :attr:`phases` and :meth:`_target`.

    Args:
        env: the scene to control, after a reset.
        gains: gains and limits; ``None`` for the defaults.

    Attributes:
        skill: the scene's current skill.
        phase: index of the current phase in :attr:`phases`.

    Example:
        >>> from torchrl_bmrl.envs.tabletop import TabletopEnv
        >>> class Up(Expert):
        ...     phases = ("up",)
        ...
        ...     def _target(self):
        ...         return self.env.eef_position + np.array([0.0, 0.0, 0.1]), OPEN, 1.0
        >>> env = TabletopEnv("lift")
        >>> observation, info = env.reset(seed=0)
        >>> Up(env.robosuite_env)().tolist()
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]
    """

    phases: ClassVar[tuple[str, ...]]

    def __init__(self, env: TabletopScene, gains: ExpertGains | None = None) -> None:
        self.env = env
        self.gains = gains or ExpertGains()
        self.skill = env.skill
        self.reset()

    def reset(self) -> None:
        """Restarts the expert; call it after every reset of the environment."""
        self.phase = 0
        self._rotation = self.env.eef_rotation

    def _target(self) -> tuple[np.ndarray, float, float]:
        """Advances the phase; returns target position (3,) [m], gripper command, speed limit."""
        raise NotImplementedError

    def _gain(self) -> float:
        return self.gains.position

    def __call__(self) -> np.ndarray:
        """Returns the action (7,) in [-1, 1] for the current state, without noise."""
        target, gripper, limit = self._target()
        delta = self._gain() * (target - self.env.eef_position) / POSITION_SCALE
        current = self.env.eef_rotation
        error = rotation_error(current, self._rotation)
        turn = self.gains.rotation * error / ROTATION_SCALE
        return np.concatenate([self._limited(delta, limit), np.clip(turn, -1, 1), [gripper]])

    def _limited(self, delta: np.ndarray, limit: float) -> np.ndarray:
        """Position action (3,) within the speed limit."""
        return np.clip(delta, -limit, limit)


class ReachExpert(Expert):
    """Moves straight to the goal; the gripper stays open or closed."""

    phases = ("reach",)

    def reset(self) -> None:
        """Restarts the expert; the gripper keeps its current command."""
        super().reset()
        self._gripper = CLOSE if self.env.gripper.closing else OPEN

    def _target(self) -> tuple[np.ndarray, float, float]:
        return self._goal(), self._gripper, self.gains.speed_limit

    def _goal(self) -> np.ndarray:
        return self.env.goal


class LiftExpert(Expert):
    """Descends to the cube, grasps it and lifts it."""

    phases = ("descend", "grasp", "lift")

    def reset(self) -> None:
        """Restarts the expert with the gripper open."""
        super().reset()
        self._closing = 0

    def _gain(self) -> float:
        return self.gains.grasp_position

    def _height(self) -> float:
        return self.gains.lift_height

    def _target(self) -> tuple[np.ndarray, float, float]:
        cube, limit = self.env.goal, self.gains.contact_speed_limit
        if self.phase == 0:
            offset = self.env.eef_position - cube
            if np.linalg.norm(offset[:2]) < 0.015 and abs(offset[2]) < 0.01:
                self.phase = 1
            # It is safe to descend only above the cube.
            elif np.linalg.norm(offset[:2]) > 0.03:
                cube = cube + np.array([0.0, 0.0, max(offset[2], 0.05)])
            return cube, OPEN, limit
        if self.phase == 1:
            self._closing += 1
            arrived = self.env.grasped or self.env.gripper.closed  # some grippers are slow
            if self._closing > self.gains.grasp_steps and arrived:
                self.phase = 2
            return cube, CLOSE, limit
        if self._lost(cube):
            self.phase, self._closing = 0, 0
            return cube + np.array([0.0, 0.0, 0.05]), OPEN, limit
        return self._carry(cube), CLOSE, self.gains.speed_limit

    def _lost(self, cube: np.ndarray) -> bool:
        """Whether the cube was dropped or missed."""
        return not self.env.grasped and bool(cube[2] < self.env.goal_start[2] + 0.01)

    def _carry(self, cube: np.ndarray) -> np.ndarray:
        """Target position (3,) [m] of the grasped cube."""
        top = cube.copy()
        top[2] = self.env.goal_start[2] + self._height()
        return top


class PushExpert(Expert):
    """Descends beside the cube with the gripper closed and pushes the cube over the line.

    A grasped cube is first put on the table and released.
    """

    phases = ("approach", "contact", "push", "release")
    stand_off: ClassVar[float] = 0.055
    """Distance behind the cube's centre at which the gripper descends [m]."""

    skill: Push

    def reset(self) -> None:
        """Restarts the expert; it first releases a grasped cube."""
        super().reset()
        self.phase = 3 if self.env.grasped else 0

    def _release(self) -> tuple[np.ndarray, float, float] | None:
        """Target for releasing the cube; ``None`` once the gripper is clear of it."""
        cube, eef = self.env.goal, self.env.eef_position
        limit = self.gains.contact_speed_limit
        height, up = cube[2] - self.env.goal_start[2], np.array([0.0, 0.0, 1.0])
        if self.env.grasped and height > 0.003:
            return eef - max(0.02, height) * up, CLOSE, limit
        around = self.env.gripper.gap < self.env.gripper.open_gap - RELEASE_MARGIN
        if around and eef[2] - cube[2] < 0.03:
            return eef.copy(), OPEN, limit  # opens before it rises
        if eef[2] - cube[2] < 0.06:
            return eef + 0.05 * up, OPEN, limit
        return None

    def _target(self) -> tuple[np.ndarray, float, float]:
        cube, eef, along = self.env.goal, self.env.eef_position, self.skill.direction
        behind = cube - self.stand_off * along
        offset = eef - behind
        height, horizontal = offset[2], np.linalg.norm(offset[:2])
        sideways = np.linalg.norm(offset[:2] - (offset @ along) * along[:2])
        if self.phase == 3:
            if (target := self._release()) is not None:
                return target
            self.phase = 0
        if self.phase == 2 and (sideways > 0.045 or height > 0.05):
            self.phase = 0  # the cube slipped away
        if self.phase == 0 and horizontal < 0.02:
            self.phase = 1
        if self.phase == 1 and horizontal > 0.04:
            self.phase = 0
        # An off-centre push turns the cube, and it slips away sideways.
        if self.phase == 1 and height < 0.012 and sideways < 0.008:
            self.phase = 2
        if self.phase == 0:
            # Rises first, so as not to hit the cube on the way to its other side.
            lift = np.array([0.0, 0.0, 0.05])
            clear = behind + np.array([0.0, 0.0, 0.08])
            target = clear if height > 0.045 or horizontal < 0.03 else eef + lift
            return target, CLOSE, self.gains.speed_limit
        if self.phase == 1:
            return behind, CLOSE, self.gains.speed_limit
        # The target is ahead of the cube until the cube is over the line. After that, or off
        # centre, it is clear of the cube, so that friction does not drag the cube sideways.
        pushing = cube @ along < self.gains.push_line and sideways < 0.012
        ahead = 0.05 if pushing else -self.stand_off
        return cube + ahead * along, CLOSE, self.gains.contact_speed_limit


EXPERTS: dict[type[Skill], type[Expert]] = {
    Reach: ReachExpert,
    Lift: LiftExpert,
    Push: PushExpert,
}
"""Experts of this package's skills."""


class ComposedExpert:
    """The experts of a composition's skills in turn; each starts when the one before succeeded.

    Args:
        env: the scene to control, after a reset.
        experts: the class of each skill's expert.
        gains: gains and limits; ``None`` for the defaults.
    """

    def __init__(
        self,
        env: TabletopScene,
        experts: Sequence[type[Expert]],
        gains: ExpertGains | None = None,
    ) -> None:
        self.env = env
        self.experts = experts
        self.gains = gains
        self.reset()

    def reset(self) -> None:
        """Restarts with the current skill; call it after every reset of the environment."""
        self._stage = min(self.env.stage, len(self.experts) - 1)
        self.expert = self.experts[self._stage](self.env, self.gains)

    @property
    def phases(self) -> tuple[str, ...]:
        """The current expert's phases."""
        return self.expert.phases

    @property
    def phase(self) -> int:
        """The current expert's phase."""
        return self.expert.phase

    def __call__(self) -> np.ndarray:
        """Returns the action (7,) in [-1, 1] for the current state, without noise."""
        if self.env.stage not in (self._stage, len(self.experts)):
            self.reset()
        return self.expert()


def make_expert(
    env: TabletopScene,
    gains: ExpertGains | None = None,
    *,
    experts: Sequence[type[Expert]] | None = None,
) -> Expert | ComposedExpert:
    """Returns the scripted expert of a scene's skill, or of a composition's skills in turn.

    Args:
        env: the scene, after a reset.
        gains: gains and limits; ``None`` for the defaults.
        experts: the class of each skill's expert; ``None`` for those of :data:`EXPERTS`.

    Raises:
        BMRLError: if ``experts`` is ``None`` and a skill has no expert in :data:`EXPERTS`.

    Example:
        >>> from torchrl_bmrl.envs.tabletop import TabletopEnv
        >>> env = TabletopEnv("lift")
        >>> observation, info = env.reset(seed=0)
        >>> expert = make_expert(env.robosuite_env)
        >>> for _ in range(5):
        ...     observation, *_ = env.step(expert())
        >>> expert.phases[expert.phase]
        'descend'
    """
    if experts is None:
        for skill in env.skills:
            if type(skill) not in EXPERTS:
                raise BMRLError(f"skill {skill.name} has no expert; valid: one class in experts")
        experts = [EXPERTS[type(skill)] for skill in env.skills]
    if len(experts) > 1:
        return ComposedExpert(env, experts, gains)
    return experts[0](env, gains)
