"""Goals of an action, as robosuite's controllers set them, with fewer steps in between.

robosuite inverts the frame of the arm's base at every action and computes quaternions that nobody
reads. For its default settings the goals here are the same bits without that; for all others
robosuite's own methods are called.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import robosuite.utils.transform_utils as T


class GoalSetter:
    """Sets the goals of an arm and its gripper from an action.

    Args:
        composite: robosuite's composite controller.
        arm: its controller of the arm.
        gripper: its controller of the gripper, if any.
        position: of the base, (3,) [m]; a view of MuJoCo's array.
        rotation: of the base, (3, 3); likewise.
    """

    def __init__(
        self, composite: Any, arm: Any, gripper: Any, position: np.ndarray, rotation: np.ndarray
    ) -> None:
        self.composite, self.arm, self.gripper = composite, arm, gripper
        self.position, self.rotation = position, rotation
        self.known: tuple[list[float], list[list[float]]] | None = None
        self.translated, self.pose = np.eye(4), np.eye(4)
        parts = [arm] if gripper is None else [arm, gripper]
        self.in_order = list(composite.part_controllers.values()) == parts
        self.range: tuple[Any, Any] | None = None

    def set(self, action: np.ndarray) -> None:
        """As ``CompositeController.update_state`` and ``set_goal``."""
        frame = self.position.tolist(), self.rotation.tolist()
        if frame != self.known:
            self.composite.update_state()
            self.inverse = T.pose_inv(T.make_pose(self.arm.origin_pos, self.arm.origin_ori))
            self.known = frame
        arm = self.arm
        if not self.in_order or not (
            arm.impedance_mode == "fixed"
            and arm.input_type == "delta"
            and arm.input_ref_frame == "base"
            and arm._goal_update_mode == "achieved"
            and arm.use_ori is True
            and arm.position_limits is None
            and arm.orientation_limits is None
        ):
            self.composite.set_goal(action)
            return
        start, end = self.composite._action_split_indexes[arm.part_name]
        delta = arm.scale_action(action[start:end])
        self.translated[:3, 3] = self.pose[:3, 3] = arm.ref_pos
        self.pose[:3, :3] = arm.ref_ori_mat
        position = self.inverse.dot(self.translated)[:3, 3] + delta[0:3]
        turn = T.quat2mat(T.axisangle2quat(delta[3:6]))
        rotation = np.dot(turn, self.inverse.dot(self.pose)[:3, :3])
        arm.goal_pos, arm.goal_ori = position, rotation
        if self.gripper is not None:
            name = self.gripper.part_name
            start, end = self.composite._action_split_indexes[name]
            self.gripper.set_goal(self.composite.grippers[name].format_action(action[start:end]))

    def fingers(self) -> np.ndarray:
        """As ``SimpleGripController.run_controller``."""
        gripper = self.gripper
        if gripper is None:
            return np.zeros(0)
        goal = np.array(gripper.goal_qvel)
        if gripper.use_action_scaling:
            low, high = gripper.actuator_min, gripper.actuator_max
            if self.range is None or self.range[0] is not low or self.range[1] is not high:
                self.range = low, high
                self.bias, self.weight = 0.5 * (high + low), 0.5 * (high - low)
            goal = self.bias + self.weight * goal
        gripper.vels = goal
        return goal
