"""One control period of robosuite in one call into compiled code, equal to robosuite's to the bit.

robosuite computes the torques of operational-space control in Python, 25 times per action, which
takes three quarters of a step. :class:`FastStepper` runs the physics substeps and the controller in
one compiled loop on MuJoCo's own arrays. It works for any single arm on a fixed base and does not
know a task or a robot by name. robosuite builds the model and sets the goal of each action.
"""

from __future__ import annotations

import numpy as np

from torchrl_bmrl.envs.control_period import (
    Arm,
    Base,
    Goal,
    Products,
    Robot,
    Scratch,
    control_period,
)
from torchrl_bmrl.envs.goals import GoalSetter
from torchrl_bmrl.envs.linear_algebra import NUMPYS_DGEMV, Arguments
from torchrl_bmrl.envs.obstacles import settings_obstacle, why_not_fast
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import mujoco
    from robosuite.environments.base import MujocoEnv


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
        >>> env = robosuite.make(
        ...     "Lift", "Panda", has_offscreen_renderer=False, use_camera_obs=False
        ... )
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
        self._robot = Robot(
            model=model._address,
            data=data._address,
            direct=bool(NUMPYS_DGEMV),
            lite=bool(env.lite_physics),
            arm_lite=bool(arm.lite_physics),
            site=site,
            dof=int(arm.qvel_index[0]),
            joint=int(arm.qpos_index[0]),
            actuator=int(indices[name][0]),
            fingers=np.asarray(fingers, dtype=np.int64),
            qpos=data.qpos,
            qvel=data.qvel,
            bias=data.qfrc_bias,
            inertia=data.qM,
            inertia_start=model.dof_Madr,
            parent=model.dof_parentid,
            ctrl=data.ctrl,
            limits=model.actuator_ctrlrange,
            site_position=data.site_xpos[site],
            site_rotation=data.site_xmat[site].reshape(3, 3),
        )
        self._arm = Arm(
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
        make = self._arguments = Arguments()  # kept alive, like the model and the data
        space = self._space = make.space(self._arm.mass, arm.J_full, arm.J_pos, arm.J_ori)
        wrench = np.zeros(6)
        scratch = self._scratch = Scratch(
            jacobian_position=np.zeros((3, model.nv)),
            jacobian_rotation=np.zeros((3, model.nv)),
            force=np.zeros(3),
            torque=np.zeros(3),
            error=np.zeros(3),
            joint_torque=np.zeros(n),
        )
        product = make.numpys_product
        self._products = Products(
            velocity=product(scratch.jacobian_position, data.qvel, arm.ref_pos_vel),
            angular_velocity=product(scratch.jacobian_rotation, data.qvel, arm.ref_ori_vel),
            force=product(space.position.result, scratch.force, wrench[:3]),
            torque=product(space.rotation.result, scratch.torque, wrench[3:]),
            joint_torque=product(arm.J_full.T, wrench, scratch.joint_torque),
        )
        self._goal_is_local = arm.input_ref_frame == "base"
        self._rotation = np.zeros((3, 3))
        center = model.site(f"{arm.naming_prefix}{arm.part_name}_center").id
        base = data.site_xpos[center], data.site_xmat[center].reshape(3, 3)
        self._goals = GoalSetter(self.composite, arm, self.gripper, *base)
        self._base = self._moving_base(center, *base)

    def _moving_base(self, site: int, position: np.ndarray, rotation: np.ndarray) -> Base | None:
        """Where the controller's frame moves; IIWA's turns with the first joint."""
        model, data = self.model, self.data
        if model.body_weldid[model.site_bodyid[site]] == 0:
            return None
        self._local_position, self._local_rotation = np.zeros(3), np.zeros((3, 3))
        jacobians, (velocity, angular_velocity, offset) = (
            np.zeros((2, 3, model.nv)),
            np.zeros((3, 3)),
        )
        product = self._arguments.numpys_product
        return Base(
            site=site,
            goal_is_local=self._goal_is_local,
            position=position,
            jacobian_position=jacobians[0],
            jacobian_rotation=jacobians[1],
            velocity=velocity,
            angular_velocity=angular_velocity,
            goal_offset=offset,
            velocity_product=product(jacobians[0], data.qvel, velocity),
            angular_velocity_product=product(jacobians[1], data.qvel, angular_velocity),
            goal_offset_product=product(rotation, self._local_position, offset),
            goal_rotation_product=product(rotation, self._local_rotation, self._rotation),
        )

    def serves(self, env: MujocoEnv) -> bool:
        """Whether ``env`` has the same simulator, controllers and settings as at the start."""
        return (
            self.sim is env.sim
            and self.robot is env.robots[0]
            and self.composite is self.robot.composite_controller
            and self.arm in self.composite.part_controllers.values()
            and self._robot.lite == env.lite_physics
            and self._robot.arm_lite == self.arm.lite_physics
            and self._goal_is_local == (self.arm.input_ref_frame == "base")
            and settings_obstacle(env) is None
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
        self._gripper_seen = gripper is not None and not gripper.new_update
        if gripper is not None:
            gripper.new_update = False
        try:
            self._goals.set(action)
        finally:  # as it was, should the action be refused
            arm.new_update = not self.seen
        position, rotation = arm.goal_pos, arm.goal_ori
        if self._goal_is_local:
            if self._base is not None:
                self._local_position[:], self._local_rotation[:] = position, rotation
            position = arm.origin_pos + np.dot(arm.origin_ori, position)
            rotation = np.dot(arm.origin_ori, rotation)
        self._rotation[:] = rotation
        self._evaluated = True
        self._goal = Goal(
            position=np.array(position, dtype=np.float64),
            rotation=self._rotation,
            kp=np.asarray(arm.kp, dtype=np.float64),
            kd=np.asarray(arm.kd, dtype=np.float64),
            rest=np.array(arm.initial_joint, dtype=np.float64),
            fingers=self._goals.fingers(),
        )

    def advance(self, substeps: int) -> None:
        """Moves on by some substeps of the period; those of a period may come in several calls."""
        state = self._arm
        evaluated, seen = self._evaluated, self._evaluated and self.seen
        control_period(
            substeps,
            evaluated,
            seen,
            self._robot,
            state,
            self._scratch,
            self._space,
            self._products,
            self._goal,
            self._base,
        )
        self._evaluated = False
        arm, gripper = self.arm, self.gripper
        arm.mass_matrix, arm.torques = state.mass, state.torque
        arm.joint_pos, arm.joint_vel = state.joint_position, state.joint_velocity
        arm.new_update = True
        if gripper is not None:
            gripper.new_update = True
        if gripper is not None and not (evaluated and self._gripper_seen and substeps == 1):
            gripper.joint_pos = state.coordinates[gripper.qpos_index]
            gripper.joint_vel = state.coordinates[self.model.nq :][gripper.qvel_index]
