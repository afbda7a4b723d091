"""One control period of robosuite in one call into compiled code, the same bits as its own.

robosuite computes the torques of operational-space control in Python, 25 times per action, which
takes three quarters of a step. :class:`FastStepper` runs the 25 physics substeps in one compiled
loop on MuJoCo's own arrays. robosuite remains the definition: it builds the model, sets the goal of
each action, and its own functions (``opspace_matrices``, ``nullspace_torques``,
``orientation_error``) are called in the loop. What robosuite does in plain numpy is done there in
the same order, matrix products by numpy itself: another order of additions differs in the last bit,
and a contact makes centimetres of it within a second.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchrl_bmrl.envs.caching import cached_njit
from torchrl_bmrl.envs.physics import mujoco_library
from torchrl_bmrl.envs.scene import TabletopScene
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
_mj_step1 = types.ExternalFunction("mj_step1", types.void(_address, _address))
_mj_step2 = types.ExternalFunction("mj_step2", types.void(_address, _address))
_mj_jac_site = types.ExternalFunction("mj_jacSite", types.void(*[_address] * 4, types.int32))
_mj_full_m = types.ExternalFunction("mj_fullM", types.void(*[_address] * 3))
_mj_fwd_position = types.ExternalFunction("mj_fwdPosition", types.void(_address, _address))
_py_call = types.ExternalFunction("PyObject_Call", _address(*[_address] * 3))
_py_decref = types.ExternalFunction("Py_DecRef", types.void(_address))


class _Robot(NamedTuple):
    """What stays the same from step to step: views of MuJoCo's arrays, indices, limits."""

    model: int  # address
    data: int  # address
    dot: int  # address of np.dot
    site: int  # end-effector
    dof: int  # first of the arm's in qvel
    joint: int  # first of the arm's in qpos
    actuator: int  # first of the arm's in ctrl
    qpos: np.ndarray
    qvel: np.ndarray
    bias: np.ndarray
    inertia: np.ndarray
    ctrl: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    low: np.ndarray
    high: np.ndarray


class _Scratch(NamedTuple):
    """Room for the results of each substep, with robosuite's shapes and memory layouts."""

    jacobian_position: np.ndarray  # (3, nv)
    jacobian_rotation: np.ndarray  # (3, nv)
    full_mass: np.ndarray  # (nv, nv)
    mass: np.ndarray  # (n, n)
    arm_position: np.ndarray  # (3, n)
    arm_rotation: np.ndarray  # (3, n)
    arm_jacobian: np.ndarray  # (6, n)
    velocity: np.ndarray  # (3,)
    angular_velocity: np.ndarray  # (3,)
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


class _Goal(NamedTuple):
    """Where the arm is to go, and how stiffly."""

    position: np.ndarray  # (3,) [m], world
    rotation: np.ndarray  # (3, 3), world
    kp: np.ndarray  # (6,)
    kd: np.ndarray  # (6,)
    rest: np.ndarray  # (n,) [rad], of the null space


@cached_njit
def _numpy_dot(dot: int, arguments: int) -> None:
    # numpy's BLAS is not the one that numba calls, and rounds differently.
    _py_decref(_py_call(dot, arguments, 0))


@cached_njit
def _control_period(
    substeps: int, robot: _Robot, scratch: _Scratch, products: _Products, goal: _Goal
) -> None:
    """``OperationalSpaceController.run_controller`` and the physics, ``substeps`` times.

    The first ``mj_step1`` has been made by the caller, who needed the poses to set the goal.
    """
    n, first = len(robot.low), robot.dof
    joints, dofs = slice(robot.joint, robot.joint + n), slice(first, first + n)
    for substep in range(substeps):
        if substep:
            _mj_step1(robot.model, robot.data)
        _mj_jac_site(
            robot.model,
            robot.data,
            scratch.jacobian_position.ctypes.data,
            scratch.jacobian_rotation.ctypes.data,
            robot.site,
        )
        _mj_full_m(robot.model, scratch.full_mass.ctypes.data, robot.inertia.ctypes.data)
        _numpy_dot(robot.dot, products.velocity)
        _numpy_dot(robot.dot, products.angular_velocity)
        scratch.mass[:] = scratch.full_mass[dofs, dofs]
        scratch.arm_position[:] = scratch.jacobian_position[:, dofs]
        scratch.arm_rotation[:] = scratch.jacobian_rotation[:, dofs]
        scratch.arm_jacobian[:3] = scratch.arm_position
        scratch.arm_jacobian[3:] = scratch.arm_rotation
        error = orientation_error(goal.rotation, robot.rotation)
        for i in range(3):
            scratch.force[i] = (goal.position[i] - robot.position[i]) * goal.kp[i] + (
                -scratch.velocity[i]
            ) * goal.kd[i]
            scratch.torque[i] = (
                error[i] * goal.kp[i + 3] + (-scratch.angular_velocity[i]) * goal.kd[i + 3]
            )
        _, lambda_position, lambda_rotation, nullspace = opspace_matrices(
            scratch.mass, scratch.arm_jacobian, scratch.arm_position, scratch.arm_rotation
        )
        scratch.lambda_position[:] = lambda_position
        scratch.lambda_rotation[:] = lambda_rotation
        _numpy_dot(robot.dot, products.force)
        _numpy_dot(robot.dot, products.torque)
        _numpy_dot(robot.dot, products.joint_torque)
        rest = nullspace_torques(
            scratch.mass, nullspace, goal.rest, robot.qpos[joints], robot.qvel[dofs]
        )
        for i in range(n):
            torque = (scratch.joint_torque[i] + robot.bias[first + i]) + rest[i]
            robot.ctrl[robot.actuator + i] = min(max(torque, robot.low[i]), robot.high[i])
        _mj_step2(robot.model, robot.data)
    # Poses lag the joints by one substep; the observation is a function of the state.
    _mj_fwd_position(robot.model, robot.data)


def why_not_fast(env: TabletopScene) -> str | None:
    """What keeps :class:`FastStepper` from standing in for ``env.step``, or ``None``.

    Args:
        env: robosuite environment, reset.
    """
    if isinstance(_library, str):
        return _library
    robot = env.robots[0]
    composite = robot.composite_controller
    arm, gripper = (composite.part_controllers.get(name) for name in ("right", "right_gripper"))
    kind = type(env)
    if len(env.robots) != 1 or type(robot) is not FixedBaseRobot:
        return "it moves one robot with a fixed base"
    if kind.step is not MujocoEnv.step or kind._pre_action is not RobotEnv._pre_action:
        return f"{kind.__name__} has a step of its own"
    if env._observables or env.has_renderer:
        return "robosuite's observables and viewer follow every substep"
    if type(composite) is not CompositeController or len(composite.part_controllers) != 2:
        return f"{type(composite).__name__} is not one arm and one gripper"
    if type(arm) is not OperationalSpaceController or not arm.uncoupling:
        return f"{type(arm).__name__} is not operational-space control with uncoupled rotation"
    if type(gripper) is not SimpleGripController:
        return f"{type(gripper).__name__} is not SimpleGripController"
    if any((arm.interpolator_pos, arm.interpolator_ori, gripper.interpolator)):
        return "it does not interpolate goals"
    if not (env.lite_physics and arm.lite_physics):
        return "lite_physics is off"
    if not isinstance(opspace_matrices, numba.core.dispatcher.Dispatcher):
        return "robosuite's macro ENABLE_NUMBA is off"
    model = env.sim.model._model
    base = model.site(f"{arm.naming_prefix}{arm.part_name}_center").bodyid[0]
    if model.body_weldid[base] != 0:
        return "the arm's base moves"
    actuators = robot._ref_actuators_indexes_dict["right"]
    for indices in (arm.qpos_index, arm.qvel_index, actuators):
        if list(indices) != list(range(indices[0], indices[0] + arm.joint_dim)):
            return "the arm's joints are not in a row"
    return None


class FastStepper:
    """Advances one robosuite environment by a control period: what ``env.step`` does to its state.

    Positions, velocities and everything computed from them are the same bits as robosuite's own;
    so are they when some steps of an episode are made by one and some by the other. Reward and
    observation are left to the caller. Lasts from one reset to the next.

    Args:
        env: robosuite environment, reset.

    Raises:
        BMRLError: if :func:`why_not_fast` gives a reason.

    Example:
        >>> env = TabletopScene("lift", seed=0, use_object_obs=False)
        >>> _ = env.reset()
        >>> before = env.eef_position
        >>> FastStepper(env).step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]))
        >>> bool(env.eef_position[2] > before[2])
        True
    """

    def __init__(self, env: TabletopScene) -> None:
        if (reason := why_not_fast(env)) is not None:
            raise BMRLError(f"no fast step here: {reason}")
        robot, self.sim = env.robots[0], env.sim
        self.composite = robot.composite_controller
        self._arm, self._gripper = self.composite.part_controllers.values()
        self._substeps = int(env.control_timestep / env.model_timestep)
        # Held: the addresses below are theirs.
        self._model, self._data = env.sim.model._model, env.sim.data._data
        model, data, n = self._model, self._data, self._arm.joint_dim
        site = model.site(self._arm.ref_name).id
        arm, self._fingers = (
            np.asarray(robot._ref_actuators_indexes_dict[name])
            for name in ("right", "right_gripper")
        )
        limits = model.actuator_ctrlrange
        self._finger_limits = limits[self._fingers].T.copy()
        self._robot = _Robot(
            model=model._address,
            data=data._address,
            dot=id(np.dot),
            site=site,
            dof=int(self._arm.qvel_index[0]),
            joint=int(self._arm.qpos_index[0]),
            actuator=int(arm[0]),
            qpos=data.qpos,
            qvel=data.qvel,
            bias=data.qfrc_bias,
            inertia=data.qM,
            ctrl=data.ctrl,
            position=data.site_xpos[site],
            rotation=data.site_xmat[site].reshape(3, 3),
            low=limits[arm, 0].copy(),
            high=limits[arm, 1].copy(),
        )
        wrench = np.zeros(6)
        scratch = self._scratch = _Scratch(
            jacobian_position=np.zeros((3, model.nv)),
            jacobian_rotation=np.zeros((3, model.nv)),
            full_mass=np.zeros((model.nv, model.nv)),
            mass=np.zeros((n, n), order="F"),
            arm_position=np.zeros((3, n)),
            arm_rotation=np.zeros((3, n)),
            arm_jacobian=np.zeros((6, n)),
            velocity=np.zeros(3),
            angular_velocity=np.zeros(3),
            lambda_position=np.zeros((3, 3), order="F"),
            lambda_rotation=np.zeros((3, 3), order="F"),
            force=np.zeros(3),
            torque=np.zeros(3),
            joint_torque=np.zeros(n),
        )
        # Held, like the model and the data.
        self._arguments = {
            "velocity": (scratch.jacobian_position, data.qvel, scratch.velocity),
            "angular_velocity": (scratch.jacobian_rotation, data.qvel, scratch.angular_velocity),
            "force": (scratch.lambda_position, scratch.force, wrench[:3]),
            "torque": (scratch.lambda_rotation, scratch.torque, wrench[3:]),
            "joint_torque": (scratch.arm_jacobian.T, wrench, scratch.joint_torque),
        }
        self._products = _Products(**{name: id(each) for name, each in self._arguments.items()})

    def serves(self, env: TabletopScene) -> bool:
        """Whether ``env`` still is as it was: no reset since, the same simulator."""
        return self.sim is env.sim and self.composite is env.robots[0].composite_controller

    def step(self, action: np.ndarray) -> None:
        """Acts for one control period.

        Args:
            action: as for ``env.step``.
        """
        arm, gripper = self._arm, self._gripper
        mujoco.mj_step1(self._model, self._data)
        # All that setting a goal reads of the arm; the rest of its update is made in the loop.
        arm.ref_pos[:], arm.ref_ori_mat[:] = self._robot.position, self._robot.rotation
        arm.new_update = gripper.new_update = False
        self.composite.update_state()
        self.composite.set_goal(action)
        position, rotation = arm.goal_pos, arm.goal_ori
        if arm.input_ref_frame == "base":
            position = arm.origin_pos + np.dot(arm.origin_ori, position)
            rotation = np.dot(arm.origin_ori, rotation)
        self._robot.ctrl[self._fingers] = np.clip(gripper.run_controller(), *self._finger_limits)
        goal = _Goal(position, rotation, arm.kp, arm.kd, np.array(arm.initial_joint))
        _control_period(self._substeps, self._robot, self._scratch, self._products, goal)
        arm.new_update = gripper.new_update = True
