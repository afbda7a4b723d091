"""Functions of robosuite's operational-space control, for the compiled loop of a control period.

Each is robosuite's own function, written without the allocations and checks that take numba seconds
to compile and longer to run than the calculation. The operations, their order and the routines are
the same. Where one of robosuite's functions is another one than this module knows (it was replaced,
or is of another version), the loop calls robosuite's.
"""

from __future__ import annotations

import hashlib
import inspect
import tokenize
from io import StringIO
from typing import Any

import numpy as np

from torchrl_bmrl.envs.caching import cached_njit
from torchrl_bmrl.envs.linear_algebra import Space, invert_space, move
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    from robosuite.utils import control_utils

OF_ROBOSUITE = (
    control_utils.orientation_error,
    control_utils.opspace_matrices,
    control_utils.nullspace_torques,
)
"""robosuite's functions."""
KNOWN = ("629a54f547a55298", "7fa718e5be3ac65a", "c960d5990b00d44f")
"""Their :func:`definition` in robosuite 1.5.2."""
_error, _matrices, _torques = OF_ROBOSUITE
_CODE = (tokenize.NAME, tokenize.NUMBER, tokenize.OP)


def definition(function: Any) -> str:
    """Hash of what a function does: its source without comments and strings; empty without source.

    Args:
        function: as numba has decorated it, or plain.
    """
    try:
        text = inspect.getsource(getattr(function, "py_func", function))
        tokens = tokenize.generate_tokens(StringIO(text).readline)
        words = [token.string for token in tokens if token.type in _CODE]
    except (OSError, SyntaxError, tokenize.TokenError):
        return ""
    return hashlib.sha256(" ".join(words).encode()).hexdigest()[:16]


if tuple(map(definition, OF_ROBOSUITE)) == KNOWN:

    @cached_njit
    def orientation_error(desired: np.ndarray, current: np.ndarray, error: np.ndarray) -> None:
        """Half the sum of the columns' cross products, into ``error``."""
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            error[i] = 0.5 * (
                (
                    (current[j, 0] * desired[k, 0] - current[k, 0] * desired[j, 0])
                    + (current[j, 1] * desired[k, 1] - current[k, 1] * desired[j, 1])
                )
                + (current[j, 2] * desired[k, 2] - current[k, 2] * desired[j, 2])
            )

    opspace_matrices = invert_space

    @cached_njit
    def nullspace_torques(
        space: Space, goal: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> None:
        """Torques in the null space towards a pose, into the space."""
        damping = np.sqrt(10) * 2
        for i in range(len(position)):
            space.acceleration[i] = 10 * (goal[i] - position[i]) - damping * velocity[i]
        move(space.to_pose)
        move(space.to_rest)

else:

    @cached_njit
    def orientation_error(desired: np.ndarray, current: np.ndarray, error: np.ndarray) -> None:
        """As robosuite's, into ``error``."""
        error[:] = _error(desired, current)

    @cached_njit
    def opspace_matrices(space: Space) -> None:
        """As robosuite's, into the space."""
        _, position, rotation, nullspace = _matrices(
            space.mass, space.jacobian, space.jacobian_position, space.jacobian_rotation
        )
        space.position.result[:] = position
        space.rotation.result[:] = rotation
        space.nullspace[:] = nullspace

    @cached_njit
    def nullspace_torques(
        space: Space, goal: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> None:
        """As robosuite's, into the space."""
        space.rest[:] = _torques(space.mass, space.nullspace, goal, position, velocity)
