#!/usr/bin/env bash
# robosuite 1.5.2: a controller with interpolation="linear", whose goals LinearInterpolator divides into
# steps.
#
# Guess: equal steps: 0.2, 0.4, 0.6, 0.8, 1 for a move of 1 in five steps.
# Seen:  0.2, 0.25, 0.33, 0.5, 1: half of each move comes in the last step. The distance that is left is
#        divided, but measured from where the move began. Orientations are right. No warning.
#        (utils/traj_utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from robosuite.utils.traj_utils import LinearInterpolator

interpolator = LinearInterpolator(ndim=1, controller_freq=500, policy_freq=20, ramp_ratio=0.2)
interpolator.set_goal(np.array([1.0]))
found = [float(interpolator.get_interpolated_goal()[0]) for _ in range(5)]
print(f"robosuite {version('robosuite')}: a move of 1 in five steps: {np.round(found, 3).tolist()}")
turn = LinearInterpolator(ndim=4, controller_freq=500, policy_freq=20, ramp_ratio=0.2, ori_interpolate="quat")
turn.set_goal(np.array([0.0, 0.0, 0.0, 1.0]))
turn.set_goal(np.array([0.0, 0.0, np.sin(0.5), np.cos(0.5)]))
angles = [float(2 * np.arctan2(*turn.get_interpolated_goal()[2:])) for _ in range(5)]
print(f"  a turn of 1 radian: {np.round(angles, 3).tolist()}")
assert np.allclose(found, [1 / 5, 1 / 4, 1 / 3, 1 / 2, 1]), found
assert np.allclose(angles, [0.2, 0.4, 0.6, 0.8, 1.0], atol=1e-3), angles
PY
