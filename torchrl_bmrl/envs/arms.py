"""What robosuite does not tell about an arm and its gripper: joints for a pose, open fingers."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_bmrl.envs.physics import kept_environment
from torchrl_bmrl.envs.rotations import rotation_error
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.extras import needs

with needs("robosuite"), kept_environment("MUJOCO_GL"):
    import mujoco

ARMS = ("Sawyer", "Panda", "UR5e", "IIWA", "Kinova3", "Jaco")
"""Arms that are tested, by robosuite's names."""
OPEN_FINGERS = {"RethinkGripper": (0.0115, -0.0115)}
"""Finger joints at rest under the command "open" [m]; those of other grippers are simulated."""
OPENING_STEPS = 10
"""Commands "open" that a gripper has received, from its middle, when an episode starts."""
SETTLING_TIME = 1.0
"""Simulated time in which the fingers come to rest [s]."""


def check_arm(robot: str) -> str:
    """Returns ``robot`` if it is an arm of :data:`ARMS`.

    Args:
        robot: robosuite's name.

    Raises:
        UnknownNameError: otherwise; the message lists the valid names.
    """
    if robot not in ARMS:
        raise UnknownNameError("robot", robot, ARMS)
    return robot


def inverse_kinematics(env: Any, target: np.ndarray) -> np.ndarray:
    """Joint positions (n,) [rad] that bring the end-effector to a point.

    At most 100 steps of damped least squares from the present joints, until each coordinate [m] and
    the rotation [rad] have an error below 1e-5; the present orientation is kept.

    Args:
        env: robosuite environment with one arm.
        target: (3,) [m].

    Raises:
        BMRLError: if no joints are found.

    Example:
        >>> from torchrl_bmrl.envs.scene import TabletopScene
        >>> scene = TabletopScene("reach", seed=0)
        >>> inverse_kinematics(scene, scene.eef_position + 0.01).shape
        (7,)
    """
    robot, model = env.robots[0], env.sim.model._model
    scratch = mujoco.MjData(model)
    scratch.qpos[:] = env.sim.data.qpos
    mujoco.mj_kinematics(model, scratch)
    mujoco.mj_comPos(model, scratch)
    site = robot.eef_site_id["right"]
    qpos, qvel = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
    orientation = scratch.site_xmat[site].reshape(3, 3).copy()
    jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for _ in range(100):
        current = scratch.site_xmat[site].reshape(3, 3)
        error = np.empty(6)
        error[:3] = target - scratch.site_xpos[site]
        error[3:] = rotation_error(current, orientation)
        if np.abs(error).max() < 1e-5:
            return scratch.qpos[qpos].copy()
        mujoco.mj_jacSite(model, scratch, jacp, jacr, site)
        jacobian = np.vstack([jacp[:, qvel], jacr[:, qvel]])
        damped = jacobian @ jacobian.T + 1e-4 * np.eye(6)
        step = jacobian.T @ np.linalg.solve(damped, error)
        scratch.qpos[qpos] += np.clip(step, -0.2, 0.2)
        mujoco.mj_kinematics(model, scratch)
        mujoco.mj_comPos(model, scratch)
    raise BMRLError(f"no joint positions bring the end-effector to {target}")


class Gripper:
    """The commands and finger joints of a robosuite gripper, open and closed.

    Args:
        env: robosuite environment with one arm, its simulator loaded.

    Attributes:
        model: robosuite's gripper.
        open_command: ``current_action`` when an episode starts.
        open_fingers: finger joints at rest under it, (k,) [m] or [rad].
        open_gap: :attr:`gap` of these [m].

    Example:
        >>> from torchrl_bmrl.envs.scene import TabletopScene
        >>> TabletopScene("lift", robots="Panda").gripper.open_fingers.shape
        (2,)
    """

    def __init__(self, env: Any) -> None:
        robot = env.robots[0]
        self.model = robot.gripper["right"]
        self._env = env
        self._joints = robot._ref_gripper_joint_pos_indexes["right"]
        pads = self.model.important_geoms
        self._pads = [
            np.array([env.sim.model.geom_name2id(name) for name in pads[f"{side}_fingerpad"]])
            for side in ("left", "right")
        ]
        self.open_command = self._command(-1.0, OPENING_STEPS)
        self._closed_command = self._command(1.0, round(2 / self.model.speed))
        data = mujoco.MjData(env.sim.model._model)
        data.qpos[robot._ref_joint_pos_indexes] = robot.init_qpos
        fingers = OPEN_FINGERS.get(type(self.model).__name__)
        self.open_fingers = self._settle(data) if fingers is None else np.array(fingers)
        data.qpos[self._joints] = self.open_fingers
        mujoco.mj_kinematics(env.sim.model._model, data)
        self.open_gap = self._gap(data.geom_xpos)

    def _command(self, action: float, steps: int) -> np.ndarray:
        """``current_action`` after some equal actions, from its middle."""
        before = self.model.current_action
        self.model.current_action = np.zeros(self.model.dof)
        for _ in range(steps):
            self.model.format_action(np.array([action]))
        after, self.model.current_action = self.model.current_action, before
        return np.array(after, dtype=np.float64)

    def _settle(self, data: mujoco.MjData) -> np.ndarray:
        """Finger joints at rest under the open command, the arm held where it is."""
        robot, model = self._env.robots[0], self._env.sim.model._model
        arm, velocities = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
        actuators = robot._ref_actuators_indexes_dict["right_gripper"]
        data.qpos[self._joints] = self.model.init_qpos
        held = data.qpos[arm].copy()
        low, high = model.actuator_ctrlrange[actuators].T
        data.ctrl[actuators] = 0.5 * (high + low) + 0.5 * (high - low) * self.open_command
        for _ in range(int(SETTLING_TIME / model.opt.timestep)):
            mujoco.mj_step(model, data)
            data.qpos[arm], data.qvel[velocities] = held, 0.0
        return data.qpos[self._joints].copy()

    def open(self) -> None:
        """Puts the fingers and the command where they are when an episode starts."""
        self._env.sim.data.qpos[self._joints] = self.open_fingers
        self.model.current_action = self.open_command.copy()

    @property
    def closing(self) -> bool:
        """Whether the command is on the closing side of its middle."""
        return bool(np.dot(self.model.current_action, self._closed_command) > 0)

    @property
    def closed(self) -> bool:
        """Whether the command has arrived at its closed end; fingers may hold something."""
        return bool(np.allclose(self.model.current_action, self._closed_command))

    @property
    def gap(self) -> float:
        """Distance between the centres of the two sides' finger pads [m]."""
        return self._gap(self._env.sim.data.geom_xpos)

    def _gap(self, places: np.ndarray) -> float:
        left, right = (places[pads].mean(0) for pads in self._pads)
        return float(np.linalg.norm(left - right))

    def touches(self, geom: int) -> bool:
        """Whether both sides' finger pads touch a geom.

        Args:
            geom: MuJoCo's number of the geom.
        """
        pairs = self._env.sim.data._data.contact.geom.tolist()
        touching = {each for pair in pairs if geom in pair for each in pair}
        return all(not touching.isdisjoint(pads.tolist()) for pads in self._pads)
