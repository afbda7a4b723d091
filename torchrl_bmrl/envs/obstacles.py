"""Which robosuite environments can be stepped fast."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_bmrl.envs import control_period, operational_space
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import numba
    from robosuite.controllers.composite.composite_controller import CompositeController
    from robosuite.controllers.parts.arm.osc import OperationalSpaceController
    from robosuite.controllers.parts.gripper.simple_grip import SimpleGripController
    from robosuite.environments.base import MujocoEnv
    from robosuite.environments.robot_env import RobotEnv
    from robosuite.robots import FixedBaseRobot


@dataclass(frozen=True)
class Obstacle:
    """Why an environment cannot step fast.

    Args:
        kind: one of ``library``, ``closed``, ``robots``, ``step``, ``viewer``, ``controller``,
            ``arm``, ``gripper``, ``interpolation``, ``parts``, ``numba``, ``joints``.
        reason: a sentence for a person.

    Example:
        >>> print(Obstacle("numba", "robosuite's macro ENABLE_NUMBA is off"))
        robosuite's macro ENABLE_NUMBA is off
    """

    kind: str
    reason: str

    def __str__(self) -> str:
        return self.reason


def why_not_fast(env: MujocoEnv) -> Obstacle | None:
    """What keeps robosuite's environment from being stepped fast, or ``None``.

    Args:
        env: robosuite environment without wrappers.

    Example:
        >>> from torchrl_bmrl.envs.scene import TabletopScene
        >>> why_not_fast(TabletopScene("lift")) is None
        True
    """
    return settings_obstacle(env) or _model_obstacle(env)


def settings_obstacle(env: MujocoEnv) -> Obstacle | None:
    """What may change between two steps."""
    if isinstance(control_period.LIBRARY, str):
        return Obstacle("library", control_period.LIBRARY)
    if env.sim is None:
        return Obstacle("closed", "the environment is closed")
    kind, robots = type(env), getattr(env, "robots", [])
    if len(robots) != 1 or type(robots[0]) is not FixedBaseRobot:
        names = ", ".join(type(robot).__name__ for robot in robots)
        return Obstacle("robots", f"robots are {names}; valid: one FixedBaseRobot")
    own = vars(env)
    for name, valid in _METHODS.items():
        if name in own or getattr(kind, name) is not valid:
            return Obstacle("step", f"{kind.__name__} has its own {name}")
    if kind.step is not MujocoEnv.step:
        return Obstacle("step", f"{kind.__name__} has its own step")
    if env.has_renderer:
        return Obstacle("viewer", "a viewer follows every substep (has_renderer)")
    robot = robots[0]
    composite = robot.composite_controller
    if type(composite) is not CompositeController or len(robot.arms) != 1:
        return Obstacle("controller", f"{type(composite).__name__} is not BASIC for one arm")
    (name,), parts = robot.arms, composite.part_controllers
    arm, gripper = parts.get(name), parts.get(f"{name}_gripper")
    if len(parts) != 1 + (gripper is not None):
        return Obstacle("controller", f"it controls {', '.join(parts)}; valid: arm and gripper")
    if type(arm) is not OperationalSpaceController or not arm.uncoupling:
        reason = f"{type(arm).__name__} is not operational-space control with uncoupled rotation"
        return Obstacle("arm", reason)
    if gripper is not None and type(gripper) is not SimpleGripController:
        return Obstacle("gripper", f"{type(gripper).__name__} is not SimpleGripController")
    interpolators = (
        arm.interpolator_pos,
        arm.interpolator_ori,
        getattr(gripper, "interpolator", None),
    )
    if any(interpolator is not None for interpolator in interpolators):
        return Obstacle("interpolation", "a controller interpolates its goals")
    if not all(robot._enabled_parts.get(part) for part in parts):
        return Obstacle("parts", "a part of the robot is disabled (enable_parts)")
    if not isinstance(operational_space.OF_ROBOSUITE[1], numba.core.dispatcher.Dispatcher):
        return Obstacle("numba", "robosuite's macro ENABLE_NUMBA is off")
    return None


_METHODS = {
    "_pre_action": RobotEnv._pre_action,
    "_update_observables": MujocoEnv._update_observables,
}


def _model_obstacle(env: MujocoEnv) -> Obstacle | None:
    """What a reset may change."""
    robot = env.robots[0]
    (name,) = robot.arms
    arm = robot.composite_controller.part_controllers[name]
    for indices in (arm.qpos_index, arm.qvel_index, robot._ref_actuators_indexes_dict[name]):
        if list(indices) != list(range(indices[0], indices[0] + arm.joint_dim)):
            return Obstacle("joints", "the arm's joints are not in a row")
    if list(env.sim.model._model.dof_parentid[arm.qvel_index]) != [-1, *arm.qvel_index[:-1]]:
        return Obstacle("joints", "the arm's joints are not a chain that begins at a fixed base")
    return None
