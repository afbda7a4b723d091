#!/usr/bin/env bash
# gymnasium-robotics 1.4.2: success of the tasks in which a hand turns a block, HandManipulateBlockRotateZ.
#
# Guess: as the page says, the goal is reached if the rotation from it is below 0.1 rad.
# Seen:  a quaternion q and -q are the same orientation, but one of them counts as a full turn away, 6.28 rad.
#        After a turn past 180 degrees, which MuJoCo's own integration gives with the other sign, a block
#        exactly at its goal has the reward -1 and no success. In the dense task it has -6.28 per step. No
#        warning. (_goal_distance in envs/shadow_dexterous_hand/manipulate.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium-robotics==1.4.2 gymnasium==1.4.0 mujoco==3.3.0 numpy==2.2.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np

gymnasium.register_envs(gymnasium_robotics)


def about_z(degrees):
    half = np.radians(degrees) / 2
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


goal, block = about_z(-170), about_z(170)
mujoco.mju_quatIntegrate(block, np.array([0.0, 0.0, np.radians(20)]), 1.0)  # 190 degrees are -170
matrices = []
for quaternion in (goal, block):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    matrices.append(matrix)
assert np.allclose(*matrices)
print(f"gymnasium-robotics {version('gymnasium-robotics')}: a block at its goal, quaternions {goal.round(3)} and {block.round(3)}")
found = {}
for kind in ("", "Dense"):
    environment = gymnasium.make(f"HandManipulateBlockRotateZ{kind}-v1").unwrapped
    wanted = np.concatenate([np.zeros(3), goal])
    for name, quaternion in (("the same sign", goal), ("the other sign", block)):
        reached = np.concatenate([np.zeros(3), quaternion])
        found[kind, name] = float(environment.compute_reward(reached, wanted, {}))
        print(f"  {kind or 'Sparse'}, {name}: reward {found[kind, name]:.3f}")
assert found["", "the same sign"] == 0 and found["", "the other sign"] == -1, found
assert abs(found["Dense", "the same sign"]) < 1e-3, found
assert abs(found["Dense", "the other sign"] + 2 * np.pi) < 1e-3, found
PY
