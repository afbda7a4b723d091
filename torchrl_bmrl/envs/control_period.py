"""The compiled loop of a control period: operational-space control and MuJoCo's substeps.

robosuite remains the definition. The loop does its operations in their order, and calls the same
routines for matrix products and inverses (:mod:`torchrl_bmrl.envs.linear_algebra`): a different
order of additions changes the last bit, and contacts can turn that into millimetres
(docs/simulator.md).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchrl_bmrl.envs.caching import cached_njit
from torchrl_bmrl.envs.linear_algebra import Space, numpys_product
from torchrl_bmrl.envs.operational_space import (
    nullspace_torques,
    opspace_matrices,
    orientation_error,
)
from torchrl_bmrl.envs.physics import mujoco_library
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import mujoco
    from llvmlite import binding
    from numba import types

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


class Robot(NamedTuple):
    """What stays the same from step to step: views of MuJoCo's arrays, indices, settings."""

    model: int  # address
    data: int  # address
    direct: bool  # numpy's BLAS can be called without Python
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

    mass: np.ndarray  # (n, n), that of the space
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
    force: np.ndarray  # (3,)
    torque: np.ndarray  # (3,)
    error: np.ndarray  # (3,), of the rotation
    joint_torque: np.ndarray  # (n,)


class Products(NamedTuple):
    """Arguments of :func:`.linear_algebra.numpys_product`."""

    velocity: np.ndarray
    angular_velocity: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    joint_torque: np.ndarray


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
    velocity_product: np.ndarray  # as of Products
    angular_velocity_product: np.ndarray
    goal_offset_product: np.ndarray
    goal_rotation_product: np.ndarray


class Goal(NamedTuple):
    """Where the arm is to go, how stiffly, and what the gripper is to do."""

    position: np.ndarray  # (3,) [m], world; not used while a moving base decides
    rotation: np.ndarray  # (3, 3), world; likewise
    kp: np.ndarray  # (6,)
    kd: np.ndarray  # (6,)
    rest: np.ndarray  # (n,) [rad], of the null space
    fingers: np.ndarray  # controls of the gripper


@cached_njit
def _copy(source: np.ndarray, start: int, target: np.ndarray) -> None:
    # Into an array of one dimension; assigning slices takes numba seconds to compile.
    for i in range(len(target)):
        target[i] = source[start + i]


@cached_njit
def _copy_columns(source: np.ndarray, first: int, part: np.ndarray, whole: np.ndarray) -> None:
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            part[i, j] = whole[i, j] = source[i, first + j]


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
    robot: Robot,
    site: int,
    buffers: Scratch | Base,
    velocity: np.ndarray,
    angular_velocity: np.ndarray,
) -> None:
    # The arguments of the two products refer to the Jacobians in the buffers.
    _mj_jac_site(
        robot.model,
        robot.data,
        buffers.jacobian_position.ctypes.data,
        buffers.jacobian_rotation.ctypes.data,
        site,
    )
    numpys_product(robot.direct, velocity)
    numpys_product(robot.direct, angular_velocity)


@cached_njit
def control_period(
    substeps: int,
    evaluated: bool,
    seen: bool,
    robot: Robot,
    arm: Arm,
    scratch: Scratch,
    space: Space,
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
            _copy(robot.site_position, 0, arm.position)
            _copy_columns(robot.site_rotation, 0, arm.rotation, arm.rotation)
            _copy_columns(scratch.jacobian_position, first, arm.jacobian_position, arm.jacobian)
            lower = arm.jacobian[3:]
            _copy_columns(scratch.jacobian_rotation, first, arm.jacobian_rotation, lower)
            _copy(robot.qpos, robot.joint, arm.joint_position)
            _copy(robot.qvel, first, arm.joint_velocity)
        if base is not None:
            _velocities(
                robot, base.site, base, base.velocity_product, base.angular_velocity_product
            )
            if base.goal_is_local:
                numpys_product(robot.direct, base.goal_offset_product)
                numpys_product(False, base.goal_rotation_product)  # of two matrices
                for i in range(3):
                    goal.position[i] = base.position[i] + base.goal_offset[i]
        orientation_error(goal.rotation, arm.rotation, scratch.error)
        for i in range(3):
            slowing, turning = arm.velocity[i], arm.angular_velocity[i]
            if base is not None:
                slowing, turning = slowing - base.velocity[i], turning - base.angular_velocity[i]
            scratch.force[i] = (goal.position[i] - arm.position[i]) * goal.kp[i] + (
                -slowing * goal.kd[i]
            )
            scratch.torque[i] = scratch.error[i] * goal.kp[i + 3] + (-turning * goal.kd[i + 3])
        opspace_matrices(space)
        numpys_product(robot.direct, products.force)
        numpys_product(robot.direct, products.torque)
        numpys_product(robot.direct, products.joint_torque)
        nullspace_torques(space, goal.rest, arm.joint_position, arm.joint_velocity)
        for i in range(n):
            arm.torque[i] = (scratch.joint_torque[i] + robot.bias[first + i]) + space.rest[i]
            j = robot.actuator + i
            robot.ctrl[j] = _clipped(arm.torque[i], robot.limits[j, 0], robot.limits[j, 1])
        for i in range(len(robot.fingers)):
            j = robot.fingers[i]
            robot.ctrl[j] = _clipped(goal.fingers[i], robot.limits[j, 0], robot.limits[j, 1])
        if substep == substeps - 1:
            _copy(robot.qpos, 0, arm.coordinates[:nq])
            _copy(robot.qvel, 0, arm.coordinates[nq:])
        if robot.lite:
            _mj_step2(robot.model, robot.data)
        else:
            _mj_step(robot.model, robot.data)
