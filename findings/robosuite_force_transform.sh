#!/usr/bin/env bash
# robosuite 1.5.2: force_in_A_to_force_in_B with the pose of A in B.
#
# Guess: as the page says, a force in A becomes the same force in B: R f, as vel_in_A_to_vel_in_B turns a
#        velocity by R.
# Seen:  it is turned by the transpose. With A turned by 90 degrees, the force (1, 0, 0) becomes (0, -1, 0)
#        instead of (0, 1, 0). The power, force times velocity, should be the same in both frames and is not.
#        Frames that are not turned are right. No warning. (utils/transform_utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from robosuite.utils.transform_utils import force_in_A_to_force_in_B, vel_in_A_to_vel_in_B

pose = np.eye(4)
pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # A is turned by 90 degrees about z: its x axis is y of B
force, torque = force_in_A_to_force_in_B(np.array([1.0, 0, 0]), np.zeros(3), pose)
velocity, _ = vel_in_A_to_vel_in_B(np.array([1.0, 0, 0]), np.zeros(3), pose)
print(f"robosuite {version('robosuite')}: (1, 0, 0) of a frame whose x axis is y")
print(f"  as a velocity {velocity + 0.0}, as a force {force + 0.0}; their power in A 1, in B {force @ velocity}")
assert np.allclose(velocity, [0, 1, 0]) and np.allclose(force, [0, -1, 0]), (velocity, force)
straight, _ = force_in_A_to_force_in_B(np.array([1.0, 0, 0]), np.zeros(3), np.eye(4))
assert np.allclose(straight, [1, 0, 0])
PY
