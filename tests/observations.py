"""The observation of the six tasks, as the documentation defines it."""

OBSERVATION_SHAPES: dict[str, int] = {
    "robot0_joint_pos": 7,
    "robot0_gripper_qpos": 2,
    "robot0_joint_vel": 7,
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "goal_pos": 3,
}
"""Parts of the six tasks' observation and their sizes, in the order of the environment."""
