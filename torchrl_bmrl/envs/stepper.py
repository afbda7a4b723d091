"""One control period of robosuite in one call into compiled code, equal to robosuite's to the bit.

robosuite computes the torques of operational-space control in Python, 25 times per action, which
takes three quarters of a step. :class:`FastStepper` runs the physics substeps and the controller in
one compiled loop on MuJoCo's own arrays. It works for any single arm on a fixed base and does not
know a task or a robot by name.

robosuite remains the definition. It builds the model and sets the goal of each action, and the loop
calls its compiled functions (``opspace_matrices``, ``nullspace_torques``, ``orientation_error``).
Where robosuite uses plain numpy, the loop does the same operations in the same order and calls
numpy for matrix products: a different order of additions changes the last bit, and contacts turn
that into centimetres within a second.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchrl_bmrl.envs.caching import cached_njit
from torchrl_bmrl.envs.physics import mujoco_library
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import mujoco
    import numba
    from llvmlite import binding
    from numba import types
    from robosuite.controllers.composite.composite_controller import CompositeController
    from robosuite.controllers.parts.arm.osc import OperationalSpaceController
    from robosuite.controllers.parts.gripper.simple_grip import SimpleGripController
    from robosuite.environments.base import MujocoEnv
    from robosuite.environments.robot_env import RobotEnv
    from robosuite.robots import FixedBaseRobot
    from robosuite.utils.control_utils import (
        nullspace_torques,
        opspace_matrices,
        orientation_error,
    )

# Compiled code finds its functions by name.
_library = mujoco_library(Path(mujoco.__file__).parent, mujoco.__version__, sys.platform)
if isinstance(_library, Path):
    binding.load_library_permanently(str(_library))
_address = types.uintp
_mj_step = types.ExternalFunction("mj_step", types.void(_address, _address))
_mj_step1 = types.ExternalFunction("mj_step1", types.void(_address, _address))
_mj_step2 = types.ExternalFunction("mj_step2", types.void(_address, _address))
_mj_forward = types.ExternalFunction("mj_forward", types.void(_address, _address))
_mj_jac_site = types.ExternalFunction("mj_jacSite", types.void(*[_address] * 4, types.int32))
_mj_full_m = types.ExternalFunction("mj_fullM", types.void(*[_address] * 3))
_py_call = types.ExternalFunction("PyObject_Call", _address(*[_address] * 3))
_py_decref = types.ExternalFunction("Py_DecRef", types.void(_address))
# Without the dispatch to other libraries' arrays, which takes as long as a small product.
_dot = getattr(np.dot, "_implementation", np.dot)


class _Robot(NamedTuple):
    """What stays the same from step to step: views of MuJoCo's arrays, indices, settings."""

    model: int  # address
    data: int  # address
    dot: int  # address of np.dot
    lite: bool  # physics in two halves, robosuite's default
    arm_lite: bool  # the controller does not evaluate the physics again
    site: int  # end-effector
    base: int  # site whose frame the goal is in; -1 if it never moves
    base_frame: bool  # the goal is in that frame, and not in the world's
    dof: int  # first of the arm's in qvel
    joint: int  # first of the arm's in qpos
    actuator: int  # first of the arm's in ctrl
    fingers: np.ndarray  # the gripper's in ctrl
    qpos: np.ndarray
    qvel: np.ndarray
    bias: np.ndarray
    inertia: np.ndarray
    ctrl: np.ndarray
    limits: np.ndarray  # (nu, 2), of ctrl
    site_position: np.ndarray
    site_rotation: np.ndarray
    base_position: np.ndarray


class _Arm(NamedTuple):
    """The arm as its controller saw it last; all but the first five are the controller's own."""

    mass: np.ndarray  # (n, n)
    joint_position: np.ndarray  # (n,)
    joint_velocity: np.ndarray  # (n,)
    torque: np.ndarray  # (n,), before it is clipped
    coordinates: np.ndarray  # (nq + nv,), of all joints
    position: np.ndarray  # (3,)
    rotation: np.ndarray  # (3, 3)
    velocity: np.ndarray  # (3,)
    angular_velocity: np.ndarray  # (3,)
    jacobian_position: np.ndarray  # (3, n)
    jacobian_rotation: np.ndarray  # (3, n)
    jacobian: np.ndarray  # (6, n)


class _Scratch(NamedTuple):
    """Buffers of each substep, with robosuite's shapes and memory layouts."""

    jacobian_position: np.ndarray  # (3, nv)
    jacobian_rotation: np.ndarray  # (3, nv)
    base_jacobian_position: np.ndarray  # (3, nv)
    base_jacobian_rotation: np.ndarray  # (3, nv)
    base_velocity: np.ndarray  # (3,)
    base_angular_velocity: np.ndarray  # (3,)
    goal_offset: np.ndarray  # (3,), of the goal from the base
    goal_rotation: np.ndarray  # (3, 3), world
    mass: np.ndarray  # (nv, nv)
    lambda_position: np.ndarray  # (3, 3)
    lambda_rotation: np.ndarray  # (3, 3)
    force: np.ndarray  # (3,)
    torque: np.ndarray  # (3,)
    joint_torque: np.ndarray  # (n,)


class _Products(NamedTuple):
    """Addresses of the arguments ``(a, b, out)`` of ``np.dot``."""

    velocity: int
    angular_velocity: int
    force: int
    torque: int
    joint_torque: int
    base_velocity: int
    base_angular_velocity: int
    goal_offset: int
    goal_rotation: int


class _Goal(NamedTuple):
    """Where the arm is to go, how stiffly, and what the gripper is to do."""

    position: np.ndarray  # (3,) [m], world; not used while a moving base decides
    rotation: np.ndarray  # (3, 3), world; likewise
    kp: np.ndarray  # (6,)
    kd: np.ndarray  # (6,)
    rest: np.ndarray  # (n,) [rad], of the null space
    fingers: np.ndarray  # controls of the gripper


@cached_njit
def _numpy_dot(dot: int, arguments: int) -> None:
    # numpy's BLAS is not the one that numba calls, and rounds differently.
    _py_decref(_py_call(dot, arguments, 0))


@cached_njit
def _clipped(value: float, low: float, high: float) -> float:
    # As np.clip: NaN stays NaN, which MuJoCo reports.
    value = low if value < low else value
    return high if value > high else value


@cached_njit
def _run(
    substeps: int,
    evaluated: bool,
    seen: bool,
    robot: _Robot,
    arm: _Arm,
    scratch: _Scratch,
    products: _Products,
    goal: _Goal,
) -> None:
    """``OperationalSpaceController.run_controller`` and the physics, ``substeps`` times.

    The caller has ``evaluated`` the first substep's positions where it needed them to set the goal.
    ``seen``: the controller uses in the first substep what it has seen of the arm before, as it
    does after a reset.
    """
    n, first, nq = len(arm.torque), robot.dof, len(robot.qpos)
    joints, dofs = slice(robot.joint, robot.joint + n), slice(first, first + n)
    for substep in range(substeps):
        if substep or not evaluated:
            if robot.lite:
                _mj_step1(robot.model, robot.data)
            else:
                _mj_forward(robot.model, robot.data)
            if not robot.arm_lite:
                _mj_forward(robot.model, robot.data)
        if substep or not seen:
            _mj_jac_site(
                robot.model,
                robot.data,
                scratch.jacobian_position.ctypes.data,
                scratch.jacobian_rotation.ctypes.data,
                robot.site,
            )
            _mj_full_m(robot.model, scratch.mass.ctypes.data, robot.inertia.ctypes.data)
            _numpy_dot(robot.dot, products.velocity)
            _numpy_dot(robot.dot, products.angular_velocity)
            arm.mass[:] = scratch.mass[dofs, dofs]
            arm.position[:] = robot.site_position
            arm.rotation[:] = robot.site_rotation
            arm.jacobian_position[:] = scratch.jacobian_position[:, dofs]
            arm.jacobian_rotation[:] = scratch.jacobian_rotation[:, dofs]
            arm.jacobian[:3] = arm.jacobian_position
            arm.jacobian[3:] = arm.jacobian_rotation
            arm.joint_position[:] = robot.qpos[joints]
            arm.joint_velocity[:] = robot.qvel[dofs]
        if robot.base >= 0:
            _mj_jac_site(
                robot.model,
                robot.data,
                scratch.base_jacobian_position.ctypes.data,
                scratch.base_jacobian_rotation.ctypes.data,
                robot.base,
            )
            _numpy_dot(robot.dot, products.base_velocity)
            _numpy_dot(robot.dot, products.base_angular_velocity)
            if robot.base_frame:
                _numpy_dot(robot.dot, products.goal_offset)
                _numpy_dot(robot.dot, products.goal_rotation)
                goal.position[:] = robot.base_position + scratch.goal_offset
                goal.rotation[:] = scratch.goal_rotation
        error = orientation_error(goal.rotation, arm.rotation)
        for i in range(3):
            slowing = -(arm.velocity[i] - scratch.base_velocity[i])
            scratch.force[i] = (goal.position[i] - arm.position[i]) * goal.kp[i] + (
                slowing * goal.kd[i]
            )
            slowing = -(arm.angular_velocity[i] - scratch.base_angular_velocity[i])
            scratch.torque[i] = error[i] * goal.kp[i + 3] + slowing * goal.kd[i + 3]
        _, lambda_position, lambda_rotation, nullspace = opspace_matrices(
            arm.mass, arm.jacobian, arm.jacobian_position, arm.jacobian_rotation
        )
        scratch.lambda_position[:] = lambda_position
        scratch.lambda_rotation[:] = lambda_rotation
        _numpy_dot(robot.dot, products.force)
        _numpy_dot(robot.dot, products.torque)
        _numpy_dot(robot.dot, products.joint_torque)
        rest = nullspace_torques(
            arm.mass, nullspace, goal.rest, arm.joint_position, arm.joint_velocity
        )
        for i in range(n):
            arm.torque[i] = (scratch.joint_torque[i] + robot.bias[first + i]) + rest[i]
            j = robot.actuator + i
            robot.ctrl[j] = _clipped(arm.torque[i], robot.limits[j, 0], robot.limits[j, 1])
        for i in range(len(robot.fingers)):
            j = robot.fingers[i]
            robot.ctrl[j] = _clipped(goal.fingers[i], robot.limits[j, 0], robot.limits[j, 1])
        if substep == substeps - 1:
            arm.coordinates[:nq] = robot.qpos
            arm.coordinates[nq:] = robot.qvel
        if robot.lite:
            _mj_step2(robot.model, robot.data)
        else:
            _mj_step(robot.model, robot.data)


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
    """
    return _settings_obstacle(env) or _model_obstacle(env)


def _settings_obstacle(env: MujocoEnv) -> Obstacle | None:
    """What may change between two steps."""
    if isinstance(_library, str):
        return Obstacle("library", _library)
    if env.sim is None:
        return Obstacle("closed", "the environment is closed")
    kind, robots = type(env), getattr(env, "robots", ())
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
    parts, (name,) = composite.part_controllers, robot.arms
    arm, gripper = parts.get(name), parts.get(f"{name}_gripper")
    if len(parts) != 1 + (gripper is not None):
        return Obstacle("controller", f"it controls {', '.join(parts)}; valid: arm and gripper")
    if type(arm) is not OperationalSpaceController or not arm.uncoupling:
        reason = f"{type(arm).__name__} is not operational-space control with uncoupled rotation"
        return Obstacle("arm", reason)
    if gripper is not None and type(gripper) is not SimpleGripController:
        return Obstacle("gripper", f"{type(gripper).__name__} is not SimpleGripController")
    interpolators = arm.interpolator_pos, arm.interpolator_ori, getattr(gripper, "interpolator", None)
    if any(interpolator is not None for interpolator in interpolators):
        return Obstacle("interpolation", "a controller interpolates its goals")
    if not all(robot._enabled_parts.get(part) for part in parts):
        return Obstacle("parts", "a part of the robot is disabled (enable_parts)")
    if not isinstance(opspace_matrices, numba.core.dispatcher.Dispatcher):
        return Obstacle("numba", "robosuite's macro ENABLE_NUMBA is off")
    return None


_METHODS = {
    "_pre_action": RobotEnv._pre_action,
    "_update_observables": MujocoEnv._update_observables,
}


def _model_obstacle(env: MujocoEnv) -> Obstacle | None:
    """What a reset may change."""
    robot, model = env.robots[0], env.sim.model._model
    (name,) = robot.arms
    arm = robot.composite_controller.part_controllers[name]
    for indices in (arm.qpos_index, arm.qvel_index, robot._ref_actuators_indexes_dict[name]):
        if list(indices) != list(range(indices[0], indices[0] + arm.joint_dim)):
            return Obstacle("joints", "the arm's joints are not in a row")
    return None


class FastStepper:
    """Advances the physics of one robosuite environment by a control period, as ``env.step`` does.

    Positions, velocities, controls and what the controllers remember are the same bits as
    robosuite's own, also where some steps of an episode are made by one and some by the other.
    Rewards and observations are left to the caller
    (:func:`~torchrl_bmrl.envs.acceleration.accelerate_robosuite` computes these, too). A stepper
    lasts from one reset to the next.

    Args:
        env: robosuite environment without wrappers.

    Raises:
        BMRLError: if :func:`why_not_fast` gives a reason.

    Example:
        >>> import robosuite
        >>> env = robosuite.make("Lift", "Panda", has_offscreen_renderer=False,
        ...                      use_camera_obs=False)
        >>> before = env.reset()["robot0_eef_pos"]
        >>> FastStepper(env).step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]))
        >>> bool(env._get_observations(force_update=True)["robot0_eef_pos"][2] > before[2])
        True
    """

    def __init__(self, env: MujocoEnv) -> None:
        if (obstacle := why_not_fast(env)) is not None:
            raise BMRLError(f"no fast step here: {obstacle}")
        self.sim, self.robot = env.sim, env.robots[0]
        self._substeps = int(env.control_timestep / env.model_timestep)
        self.composite = self.robot.composite_controller
        (name,) = self.robot.arms
        self.arm = self.composite.part_controllers[name]
        self.gripper = self.composite.part_controllers.get(f"{name}_gripper")
        # Kept alive: the addresses below are theirs.
        self.model, self.data = env.sim.model._model, env.sim.data._data
        model, data, arm, n = self.model, self.data, self.arm, self.arm.joint_dim
        indices = self.robot._ref_actuators_indexes_dict
        fingers = [] if self.gripper is None else indices[f"{name}_gripper"]
        site = model.site(arm.ref_name).id
        base = model.site(f"{arm.naming_prefix}{arm.part_name}_center")
        # On some arms, such as IIWA, the controller's frame turns with the first joint.
        moves = bool(model.body_weldid[base.bodyid[0]] != 0)
        base_rotation = data.site_xmat[base.id].reshape(3, 3)
        self._robot = _Robot(
            model=model._address,
            data=data._address,
            dot=id(_dot),
            lite=bool(env.lite_physics),
            arm_lite=bool(arm.lite_physics),
            site=site,
            base=base.id if moves else -1,
            base_frame=arm.input_ref_frame == "base",
            dof=int(arm.qvel_index[0]),
            joint=int(arm.qpos_index[0]),
            actuator=int(indices[name][0]),
            fingers=np.asarray(fingers, dtype=np.int64),
            qpos=data.qpos,
            qvel=data.qvel,
            bias=data.qfrc_bias,
            inertia=data.qM,
            ctrl=data.ctrl,
            limits=model.actuator_ctrlrange,
            site_position=data.site_xpos[site],
            site_rotation=data.site_xmat[site].reshape(3, 3),
            base_position=data.site_xpos[base.id],
        )
        self._arm = _Arm(
            mass=np.zeros((n, n), order="F"),
            joint_position=np.zeros(n),
            joint_velocity=np.zeros(n),
            torque=np.zeros(n),
            coordinates=np.zeros(model.nq + model.nv),
            position=arm.ref_pos,
            rotation=arm.ref_ori_mat,
            velocity=arm.ref_pos_vel,
            angular_velocity=arm.ref_ori_vel,
            jacobian_position=arm.J_pos,
            jacobian_rotation=arm.J_ori,
            jacobian=arm.J_full,
        )
        wrench = np.zeros(6)
        scratch = self._scratch = _Scratch(
            jacobian_position=np.zeros((3, model.nv)),
            jacobian_rotation=np.zeros((3, model.nv)),
            base_jacobian_position=np.zeros((3, model.nv)),
            base_jacobian_rotation=np.zeros((3, model.nv)),
            base_velocity=np.zeros(3),
            base_angular_velocity=np.zeros(3),
            goal_offset=np.zeros(3),
            goal_rotation=np.zeros((3, 3)),
            mass=np.zeros((model.nv, model.nv)),
            lambda_position=np.zeros((3, 3), order="F"),
            lambda_rotation=np.zeros((3, 3), order="F"),
            force=np.zeros(3),
            torque=np.zeros(3),
            joint_torque=np.zeros(n),
        )
        self._local_position, self._local_rotation = np.zeros(3), np.zeros((3, 3))
        # Kept alive, like the model and the data.
        self._arguments = {
            "velocity": (scratch.jacobian_position, data.qvel, arm.ref_pos_vel),
            "angular_velocity": (scratch.jacobian_rotation, data.qvel, arm.ref_ori_vel),
            "force": (scratch.lambda_position, scratch.force, wrench[:3]),
            "torque": (scratch.lambda_rotation, scratch.torque, wrench[3:]),
            "joint_torque": (arm.J_full.T, wrench, scratch.joint_torque),
            "base_velocity": (scratch.base_jacobian_position, data.qvel, scratch.base_velocity),
            "base_angular_velocity": (
                scratch.base_jacobian_rotation,
                data.qvel,
                scratch.base_angular_velocity,
            ),
            "goal_offset": (base_rotation, self._local_position, scratch.goal_offset),
            "goal_rotation": (base_rotation, self._local_rotation, scratch.goal_rotation),
        }
        self._products = _Products(**{name: id(each) for name, each in self._arguments.items()})

    def serves(self, env: MujocoEnv) -> bool:
        """Whether ``env`` is as it was: no reset since, same simulator, controllers and settings."""
        return (
            self.sim is env.sim
            and self.robot is env.robots[0]
            and self.composite is self.robot.composite_controller
            and self.arm in self.composite.part_controllers.values()
            and self._robot.lite == env.lite_physics
            and self._robot.arm_lite == self.arm.lite_physics
            and self._robot.base_frame == (self.arm.input_ref_frame == "base")
            and _settings_obstacle(env) is None
        )

    def step(self, action: np.ndarray) -> None:
        """Acts for one control period; poses are then those of the joints.

        robosuite's own step leaves poses one substep behind the joints. With poses that follow from
        the joints, an observation is a function of the state.

        Args:
            action: as for ``env.step``.
        """
        self.begin(action)
        self.advance(self._substeps)
        mujoco.mj_fwdPosition(self.model, self.data)

    def begin(self, action: np.ndarray) -> None:
        """Evaluates the positions and sets the controllers' goals, as each first substep does."""
        arm, gripper, robot = self.arm, self.gripper, self._robot
        (mujoco.mj_step1 if robot.lite else mujoco.mj_forward)(self.model, self.data)
        self.seen = not arm.new_update
        if self.seen:
            self._arm.mass[:] = arm.mass_matrix
            self._arm.joint_position[:] = arm.joint_pos
            self._arm.joint_velocity[:] = arm.joint_vel
        else:
            if not robot.arm_lite:
                mujoco.mj_forward(self.model, self.data)
            # All that setting a goal reads of the arm; the rest of its update is in the loop.
            arm.ref_pos[:], arm.ref_ori_mat[:] = robot.site_position, robot.site_rotation
            arm.new_update = False
        if gripper is not None:
            gripper.new_update = False
        self.composite.update_state()
        try:
            self.composite.set_goal(action)
        finally:  # as it was, should the action be refused
            arm.new_update = not self.seen
        position, rotation = arm.goal_pos, arm.goal_ori
        if robot.base_frame:
            self._local_position[:], self._local_rotation[:] = position, rotation
            position = arm.origin_pos + np.dot(arm.origin_ori, position)
            rotation = np.dot(arm.origin_ori, rotation)
        self._evaluated = True
        self._goal = _Goal(
            position=np.array(position, dtype=np.float64),
            rotation=np.array(rotation, dtype=np.float64, order="C"),
            kp=np.asarray(arm.kp, dtype=np.float64),
            kd=np.asarray(arm.kd, dtype=np.float64),
            rest=np.array(arm.initial_joint, dtype=np.float64),
            fingers=np.zeros(0) if gripper is None else gripper.run_controller(),
        )

    def advance(self, substeps: int) -> None:
        """Moves on by some substeps of the period; those of a period may come in several calls."""
        state = self._arm
        evaluated, seen = self._evaluated, self._evaluated and self.seen
        _run(
            substeps,
            evaluated,
            seen,
            self._robot,
            state,
            self._scratch,
            self._products,
            self._goal,
        )
        self._evaluated = False
        arm, gripper = self.arm, self.gripper
        arm.mass_matrix, arm.torques = state.mass, state.torque
        arm.joint_pos, arm.joint_vel = state.joint_position, state.joint_velocity
        arm.new_update = True
        if gripper is not None:
            gripper.joint_pos = state.coordinates[gripper.qpos_index]
            gripper.joint_vel = state.coordinates[self.model.nq :][gripper.qvel_index]
            gripper.new_update = True
