"""Names of the six tasks, and positions that tests read from MuJoCo itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_bmrl.envs.skills import SKILLS
from torchrl_bmrl.envs.tabletop import TabletopEnv

TASKS = tuple(SKILLS)
DIRECTIONS = {  # of the pushes, in the world's frame
    "push_right": [0.0, -1.0, 0.0],
    "push_left": [0.0, 1.0, 0.0],
    "push_up": [1.0, 0.0, 0.0],
    "push_down": [-1.0, 0.0, 0.0],
}


def simulator(env: TabletopEnv) -> tuple[Any, Any]:
    """MuJoCo's own model and data, which the code under test wraps."""
    sim = env.robosuite_env.sim
    return sim.model._model, sim.data._data


def eef(env: TabletopEnv) -> np.ndarray:
    """Position of the end effector [m]."""
    return simulator(env)[1].site("gripper0_right_grip_site").xpos.copy()


def cube(env: TabletopEnv) -> np.ndarray:
    """Position of the cube [m]."""
    return simulator(env)[1].body("cube_main").xpos.copy()
