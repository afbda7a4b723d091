#!/usr/bin/env bash
# dm_control 1.0.50: transformations.quat_dist of two rotations.
#
# Guess: the angle between them: a quarter turn is 1.57 rad.
# Seen:  half the angle: 0.785. (utils/transformations.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet dm_control==1.0.50 mujoco==4.0.0 numpy==2.4.6

MUJOCO_GL=disable "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from dm_control.utils import transformations

one = np.array([1.0, 0.0, 0.0, 0.0])
quarter = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
found = float(np.ravel(transformations.quat_dist(one, quarter))[0])
print(f"dm_control {version('dm_control')}: a quarter turn is {found:.4f} rad")
assert abs(found - np.pi / 4) < 1e-3, found
PY
