"""Sizes and places of the tabletop scene [m]; +x points away from the robot, +y to its left."""

from __future__ import annotations

import numpy as np

CONTROL_FREQUENCY = 20
"""Actions per second [Hz]."""
TABLE_SIZE = (0.8, 0.8, 0.05)
TABLE_TOP = np.array([0.0, 0.0, 0.8])
"""Centre of the table's surface [m]; +x points away from the robot, +y to its left."""
CUBE_HALF_SIZE = 0.021
CUBE_RANGE = 0.08
"""The cube starts within this distance of the table's centre along x and along y [m]."""
HOVER_HEIGHT = 0.10
"""Height of the gripper above the cube's centre when a skill on the cube starts [m]."""
HOME = TABLE_TOP + np.array([0.0, 0.0, 0.20])
HOME_RADIUS = 0.01
"""Without a cube the end-effector starts within this distance of ``HOME`` [m]."""
TARGET_LOW = TABLE_TOP + np.array([-0.12, -0.20, 0.06])
TARGET_HIGH = TABLE_TOP + np.array([0.12, 0.20, 0.32])


def sample_home(rng: np.random.Generator) -> np.ndarray:
    """A random point within :data:`HOME_RADIUS` of :data:`HOME`, (3,) [m].

    Args:
        rng: the scene's random generator.
    """
    direction = rng.standard_normal(3)
    radius = HOME_RADIUS * rng.uniform() ** (1 / 3)
    return HOME + radius * direction / np.linalg.norm(direction)
