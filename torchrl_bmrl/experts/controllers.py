"""Scripted experts: proportional controllers that see the simulator's state.

Each expert is a short list of named phases. Everything that decides an action, but for the phase,
can be read off the policy's observation, so that the demonstrations can be learned from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from torchrl_bmrl.names import PUSH_DIRECTIONS, composition_stages

if TYPE_CHECKING:
    from torchrl_bmrl.envs.tasks import BMRLSawyerComposition, _BMRLSawyerTask

POSITION_SCALE = 0.05
"""Metres that an action of 1 asks for."""
ROTATION_SCALE = 0.5
"""Radians that an action of 1 asks for."""
OPEN, CLOSE = -1.0, 1.0


@dataclass(kw_only=True)
class ExpertGains:
    """Gains and limits of the scripted experts.

    Attributes:
        position: position error asked for in one action, as a multiple of the error.
        grasp_position: the same for lifting. A stiff expert hardly ever leaves its line, and what
            learns from it does not know the way back.
        rotation: share of the rotation error asked for in one action.
        speed_limit: largest position action of an expert in free motion, in (0, 1].
        contact_speed_limit: largest position action when coming down on the cube and when
            pushing it, in (0, 1]. At full speed the arm drifts sideways as it descends.
        grasp_steps: steps given to the gripper to close; it needs 10 from fully open.
        lift_height: height above its start that the cube is lifted to [m].
        push_line: distance from the table's centre along the direction to which the cube is
            pushed [m]. A line and not a distance from the cube's start, which no policy sees.

    Example:
        >>> gains = ExpertGains(speed_limit=0.5)
        >>> gains.speed_limit, gains.position
        (0.5, 4.0)
    """

    position: float = 4.0
    grasp_position: float = 1.5
    rotation: float = 1.0
    speed_limit: float = 1.0
    contact_speed_limit: float = 0.7
    grasp_steps: int = 10
    lift_height: float = 0.10
    push_line: float = 0.20


class Expert:
    """A scripted controller for one running robosuite environment.

    Subclasses define :attr:`phases` and :meth:`_target`.

    Args:
        env: the robosuite environment to control.
        gains: gains and limits.

    Example:
        >>> from torchrl_bmrl.envs.sawyer import SawyerEnv
        >>> class Up(Expert):
        ...     phases = ("up",)
        ...
        ...     def _target(self):
        ...         return self.env.eef_position + np.array([0.0, 0.0, 0.1]), OPEN, 1.0
        >>> env = SawyerEnv("lift")
        >>> observation, info = env.reset(seed=0)
        >>> Up(env.robosuite_env, ExpertGains())().tolist()
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]
    """

    phases: ClassVar[tuple[str, ...]]

    def __init__(self, env: _BMRLSawyerTask, gains: ExpertGains) -> None:
        self.env = env
        self.gains = gains
        self.reset()

    def reset(self) -> None:
        """Starts over; call after every reset of the environment."""
        self.phase = 0
        self._rotation = self.env.eef_rotation

    def _target(self) -> tuple[np.ndarray, float, float]:
        """Advances the phase; returns target position (3,) [m], gripper command, speed limit."""
        raise NotImplementedError

    def _gain(self) -> float:
        return self.gains.position

    def __call__(self) -> np.ndarray:
        """Noise-free action (7,) in [-1, 1] for the environment's present state."""
        target, gripper, limit = self._target()
        delta = self._gain() * (target - self.env.eef_position) / POSITION_SCALE
        current = self.env.eef_rotation
        error = 0.5 * np.cross(current, self._rotation, axis=0).sum(axis=1)
        turn = self.gains.rotation * error / ROTATION_SCALE
        return np.concatenate([np.clip(delta, -limit, limit), np.clip(turn, -1, 1), [gripper]])


class ReachExpert(Expert):
    """Straight to the goal, the gripper open or closed as it was at the start."""

    phases = ("reach",)

    def reset(self) -> None:
        """Starts over; keeps what the gripper does now."""
        super().reset()
        # The first finger's command goes up while the gripper closes.
        closing = self.env.robots[0].gripper["right"].current_action[0] > 0
        self._gripper = CLOSE if closing else OPEN

    def _target(self) -> tuple[np.ndarray, float, float]:
        return self.env.goal, self._gripper, self.gains.speed_limit


class LiftExpert(Expert):
    """Descend onto the cube, grasp it, lift it."""

    phases = ("descend", "grasp", "lift")

    def reset(self) -> None:
        """Starts over, gripper open."""
        super().reset()
        self._closing = 0

    def _gain(self) -> float:
        return self.gains.grasp_position

    def _target(self) -> tuple[np.ndarray, float, float]:
        cube, limit = self.env.goal, self.gains.contact_speed_limit
        if self.phase == 0:
            offset = self.env.eef_position - cube
            if np.linalg.norm(offset[:2]) < 0.015 and abs(offset[2]) < 0.01:
                self.phase = 1
            # Only above the cube is it safe to go down.
            elif np.linalg.norm(offset[:2]) > 0.03:
                cube = cube + np.array([0.0, 0.0, max(offset[2], 0.05)])
            return cube, OPEN, limit
        if self.phase == 1:
            self._closing += 1
            if self._closing > self.gains.grasp_steps:
                self.phase = 2
            return cube, CLOSE, limit
        top = cube.copy()
        top[2] = self.env.goal_start[2] + self.gains.lift_height
        if not self.env.grasped and cube[2] < self.env.goal_start[2] + 0.01:
            self.phase, self._closing = 0, 0  # dropped or missed
            return cube + np.array([0.0, 0.0, 0.05]), OPEN, limit
        return top, CLOSE, self.gains.speed_limit


class PushExpert(Expert):
    """Go beside the cube with the gripper closed, come down, push it over the line.

    A cube that is in the hand is first brought down to the table and let go.

    Args:
        env: the robosuite environment to control.
        gains: gains and limits.
        direction: unit vector to push along, (3,).
    """

    phases = ("approach", "contact", "push", "release")
    stand_off: ClassVar[float] = 0.055
    """Distance behind the cube's centre at which the gripper comes down [m]."""

    def __init__(
        self, env: _BMRLSawyerTask, gains: ExpertGains, direction: tuple[float, float, float]
    ) -> None:
        self._direction = np.array(direction)
        super().__init__(env, gains)

    def reset(self) -> None:
        """Starts over, by letting go of the cube if it is in the hand."""
        super().reset()
        self.phase = 3 if self.env.grasped else 0

    def _release(self) -> tuple[np.ndarray, float, float] | None:
        """Down to the table, open, and up again; ``None`` once the hand is clear of the cube."""
        cube, eef = self.env.goal, self.env.eef_position
        limit = self.gains.contact_speed_limit
        height, up = cube[2] - self.env.goal_start[2], np.array([0.0, 0.0, 1.0])
        if self.env.grasped and height > 0.003:
            return eef - max(0.02, height) * up, CLOSE, limit
        left, right = self.env.named_observation()["robot0_gripper_qpos"]
        if left - right < 0.02 and eef[2] - cube[2] < 0.03:
            return eef.copy(), OPEN, limit  # opens around the cube before it leaves
        if eef[2] - cube[2] < 0.06:
            return eef + 0.05 * up, OPEN, limit
        return None

    def _target(self) -> tuple[np.ndarray, float, float]:
        cube, eef, along = self.env.goal, self.env.eef_position, self._direction
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
        # Off centre the push turns the cube, and it slips away sideways.
        if self.phase == 1 and height < 0.012 and sideways < 0.008:
            self.phase = 2
        if self.phase == 0:
            # Rise first, so as not to knock the cube on the way to its other side.
            lift = np.array([0.0, 0.0, 0.05])
            clear = behind + np.array([0.0, 0.0, 0.08])
            target = clear if height > 0.045 or horizontal < 0.03 else eef + lift
            return target, CLOSE, self.gains.speed_limit
        if self.phase == 1:
            return behind, CLOSE, self.gains.speed_limit
        # The target is ahead of the cube until it is over the line; from there on, or off centre,
        # it is clear of the cube, where friction does not drag it along sideways.
        pushing = cube @ along < self.gains.push_line and sideways < 0.012
        ahead = 0.05 if pushing else -self.stand_off
        return cube + ahead * along, CLOSE, self.gains.contact_speed_limit


class ComposedExpert:
    """The experts of a composition's tasks, each from where the one before it succeeded.

    Args:
        env: the robosuite environment to control.
        gains: gains and limits.
    """

    def __init__(self, env: BMRLSawyerComposition, gains: ExpertGains | None = None) -> None:
        self.env = env
        self.gains = gains
        self.reset()

    def reset(self) -> None:
        """Starts over; call after every reset of the environment."""
        self._stage = self.env.stage
        self.expert = make_expert(self.env.task, self.env, self.gains)

    @property
    def phases(self) -> tuple[str, ...]:
        """The present expert's phases."""
        return self.expert.phases

    @property
    def phase(self) -> int:
        """The present expert's phase."""
        return self.expert.phase

    def __call__(self) -> np.ndarray:
        """Noise-free action (7,) in [-1, 1] for the environment's present state."""
        if self.env.stage not in (self._stage, len(self.env.stages)):
            self.reset()
        return self.expert()


def make_expert(
    task: str, env: _BMRLSawyerTask, gains: ExpertGains | None = None
) -> Expert | ComposedExpert:
    """Scripted expert for a task's robosuite environment, or for a composition's.

    Args:
        task: one of the six, or a composition: several joined by ``-``.
        env: the robosuite environment of that task, after a reset.
        gains: gains and limits; ``None`` for the defaults.

    Returns:
        what gives an action (7,) in [-1, 1] when it is called, for the environment's present state.

    Raises:
        UnknownNameError: for a name that is not a task.

    Example:
        >>> from torchrl_bmrl.envs.sawyer import SawyerEnv
        >>> env = SawyerEnv("lift")
        >>> observation, info = env.reset(seed=0)
        >>> expert = make_expert("lift", env.robosuite_env)
        >>> for _ in range(5):
        ...     observation, *_ = env.step(expert())
        >>> expert.phases[expert.phase]
        'descend'
    """
    gains = gains or ExpertGains()
    if len(composition_stages(task)) > 1:
        return ComposedExpert(env, gains)
    if task == "reach":
        return ReachExpert(env, gains)
    if task == "lift":
        return LiftExpert(env, gains)
    return PushExpert(env, gains, PUSH_DIRECTIONS[task.removeprefix("push_")])
