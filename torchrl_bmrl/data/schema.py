"""What a demonstration must look like before anything trains on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchrl_bmrl.errors import DataError

OBSERVATION_SHAPES: dict[str, int] = {
    "robot0_joint_pos": 7,
    "robot0_gripper_qpos": 2,
    "robot0_joint_vel": 7,
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "goal_pos": 3,
}
"""Parts of the observation and their sizes, in the environment's order."""
ACTION_DIM = 7
ACTION_TOLERANCE = 1e-6


def check_episode(path: Path, demo: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Checks the arrays of one demonstration.

    Args:
        path: file, for the message.
        demo: group of the demonstration, for the message.
        arrays: by key relative to the group: ``actions``, ``rewards``, ``successes``, ``obs/...``
            and ``next_obs/...``.

    Raises:
        DataError: for the first array with a wrong shape, a value that is not finite, or an action
            outside [-1, 1]; the message names the expected shape or the row.

    Example:
        >>> check_episode(Path("a.hdf5"), "data/demo_0", {"actions": np.full((4, 7), 2.0)})
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: a.hdf5: data/demo_0/actions: 2.0 in row 0 is outside [-1, 1]
    """
    actions = arrays["actions"]
    steps = len(actions) if actions.ndim else 0
    if steps == 0:
        message = f"shape {actions.shape}; valid: (T, {ACTION_DIM}) with at least one step"
        raise DataError(path, f"{demo}/actions", message)
    for key, array in arrays.items():
        name = f"{demo}/{key}"
        if array.dtype.kind not in "biuf":
            raise DataError(path, name, f"dtype {array.dtype}; valid: numbers")
        part = key.rsplit("/", 1)[-1]
        expected: tuple[int, ...] = (steps,)
        if key == "actions":
            expected = (steps, ACTION_DIM)
        elif "/" in key:
            expected = (
                steps,
                OBSERVATION_SHAPES.get(part, array.shape[-1] if array.ndim > 1 else 1),
            )
        if array.shape != expected:
            raise DataError(path, name, f"shape {array.shape}; valid: {expected}")
        finite = np.isfinite(array)
        if not finite.all():
            row = int(np.argwhere(~finite)[0][0])
            raise DataError(path, name, f"a value that is not finite in row {row}")
    outside = np.argwhere(np.abs(actions) > 1 + ACTION_TOLERANCE)
    if len(outside):
        row, column = outside[0]
        value = float(actions[row, column])
        raise DataError(path, f"{demo}/actions", f"{value} in row {row} is outside [-1, 1]")
