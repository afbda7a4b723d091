"""Rotations, without the simulator."""

from __future__ import annotations

import numpy as np


def rotation_error(current: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """Half the sum of the cross products of two rotations' columns, (3,), small angles in [rad].

    Args:
        current: rotation matrix, (3, 3).
        desired: likewise.

    Example:
        >>> rotation_error(
        ...     np.eye(3), np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
        ... )
        array([0.6, 0. , 0. ])
    """
    # Numbers of Python: numpy's cross takes ten times as long.
    a, b = current.tolist(), desired.tolist()
    error = np.empty(3)
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        first, second, third = (a[j][n] * b[k][n] - a[k][n] * b[j][n] for n in range(3))
        error[i] = 0.5 * (first + second + third)
    return error
