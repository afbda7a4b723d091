"""The compiled loop of a control period: operational-space control and MuJoCo's substeps.

robosuite remains the definition. The loop calls its compiled functions (``opspace_matrices``,
``nullspace_torques``, ``orientation_error``). Where robosuite uses plain numpy, the loop does the
same operations in the same order and calls numpy for matrix products: a different order of
additions changes the last bit, and contacts can turn that into millimetres (docs/simulator.md).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchrl_bmrl.envs.caching import cached_njit
from torchrl_bmrl.envs.physics import mujoco_library
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import mujoco
    from llvmlite import binding
    from numba import types
    from robosuite.utils.control_utils import (
        nullspace_torques,
        opspace_matrices,
        orientation_error,
    )

# Compiled code finds its functions by name.
LIBRARY = mujoco_library(Path(mujoco.__file__).parent, mujoco.__version__, sys.platform)
if isinstance(LIBRARY, Path):
    binding.load_library_permanently(str(LIBRARY))
_address = types.uintp
_mj_step = types.ExternalFunction("mj_step", types.void(_address, _address))
_mj_step1 = types.ExternalFunction("mj_step1", types.void(_address, _address))
_mj_step2 = types.ExternalFunction("mj_step2", types.void(_address, _address))
_mj_forward = types.ExternalFunction("mj_forward", types.void(_address, _address))
_mj_jac_site = types.ExternalFunction("mj_jacSite", types.void(*[_address] * 4, types.int32))
_py_call = types.ExternalFunction("PyObject_Call", _address(*[_address] * 3))
_py_decref = types.ExternalFunction("Py_DecRef", types.void(_address))
# Without the dispatch to other libraries' arrays, which takes as long as a small product.
DOT = getattr(np.dot, "_implementation", np.dot)


class Robot(NamedTuple):
    """What stays the same from step to step: views of MuJoCo's arrays, indices, settings."""

    model: int  # address
    data: int  # address
    dot: int  # address of np.dot
    lite: bool  # physics in two halves, robosuite's default
    arm_lite: bool  # the controller does not evaluate the physics again
    site: int  # end-effector
    dof: int  # first of the arm's in qvel
    joint: int  # first of the arm's in qpos
    actuator: int  # first of the arm's in ctrl
    fingers: np.ndarray  # the gripper's in ctrl
    qpos: np.ndarray
    qvel: np.ndarray
    bias: np.ndarray
    inertia: np.ndarray  # sparse: each joint's row from the diagonal towards the base
    inertia_start: np.ndarray  # (nv,), of the rows
    parent: np.ndarray  # (nv,), the joint before, or -1
    ctrl: np.ndarray
    limits: np.ndarray  # (nu, 2), of ctrl
    site_position: np.ndarray
    site_rotation: np.ndarray


class Arm(NamedTuple):
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


class Scratch(NamedTuple):
    """Buffers of each substep, with robosuite's shapes and memory layouts."""

    jacobian_position: np.ndarray  # (3, nv)
    jacobian_rotation: np.ndarray  # (3, nv)
    lambda_position: np.ndarray  # (3, 3)
    lambda_rotation: np.ndarray  # (3, 3)
    force: np.ndarray  # (3,)
    torque: np.ndarray  # (3,)
    joint_torque: np.ndarray  # (n,)


class Products(NamedTuple):
    """Addresses of the arguments ``(a, b, out)`` of ``np.dot``."""

    velocity: int
    angular_velocity: int
    force: int
    torque: int
    joint_torque: int


class Base(NamedTuple):
    """The site whose frame goals are in, where it moves with the arm."""

    site: int
    goal_is_local: bool  # in that frame, and not in the world's
    position: np.ndarray  # (3,), view of MuJoCo's
    jacobian_position: np.ndarray  # (3, nv)
    jacobian_rotation: np.ndarray  # (3, nv)
    velocity: np.ndarray  # (3,)
    angular_velocity: np.ndarray  # (3,)
    goal_offset: np.ndarray  # (3,), of the goal from the site
    velocity_product: int  # addresses, as of Products
    angular_velocity_product: int
    goal_offset_product: int
    goal_rotation_product: int


class Goal(NamedTuple):
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
def _mass_matrix(robot: Robot, mass: np.ndarray) -> None:
    # The arm's block of what mj_fullM copies, without the zeros of all other joints.
    n, first = len(mass), robot.dof
    for i in range(n):
        entry, j = robot.inertia_start[first + i], first + i
        while j >= first:
            mass[i, j - first] = mass[j - first, i] = robot.inertia[entry]
            entry, j = entry + 1, robot.parent[j]


@cached_njit
def _velocities(
    robot: Robot, site: int, buffers: Scratch | Base, velocity: int, angular_velocity: int
) -> None:
    # The arguments of the two products refer to the Jacobians in the buffers.
    _mj_jac_site(
        robot.model,
        robot.data,
        buffers.jacobian_position.ctypes.data,
        buffers.jacobian_rotation.ctypes.data,
        site,
    )
    _numpy_dot(robot.dot, velocity)
    _numpy_dot(robot.dot, angular_velocity)


@cached_njit
def control_period(
    substeps: int,
    evaluated: bool,
    seen: bool,
    robot: Robot,
    arm: Arm,
    scratch: Scratch,
    products: Products,
    goal: Goal,
    base: Base | None,
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
            _velocities(robot, robot.site, scratch, products.velocity, products.angular_velocity)
            _mass_matrix(robot, arm.mass)
            arm.position[:] = robot.site_position
            arm.rotation[:] = robot.site_rotation
            arm.jacobian_position[:] = scratch.jacobian_position[:, dofs]
            arm.jacobian_rotation[:] = scratch.jacobian_rotation[:, dofs]
            arm.jacobian[:3] = arm.jacobian_position
            arm.jacobian[3:] = arm.jacobian_rotation
            arm.joint_position[:] = robot.qpos[joints]
            arm.joint_velocity[:] = robot.qvel[dofs]
        if base is not None:
            _velocities(
                robot, base.site, base, base.velocity_product, base.angular_velocity_product
            )
            if base.goal_is_local:
                _numpy_dot(robot.dot, base.goal_offset_product)
                _numpy_dot(robot.dot, base.goal_rotation_product)
                goal.position[:] = base.position + base.goal_offset
        error = orientation_error(goal.rotation, arm.rotation)
        for i in range(3):
            slowing, turning = arm.velocity[i], arm.angular_velocity[i]
            if base is not None:
                slowing, turning = slowing - base.velocity[i], turning - base.angular_velocity[i]
            scratch.force[i] = (goal.position[i] - arm.position[i]) * goal.kp[i] + (
                -slowing * goal.kd[i]
            )
            scratch.torque[i] = error[i] * goal.kp[i + 3] + (-turning * goal.kd[i + 3])
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
