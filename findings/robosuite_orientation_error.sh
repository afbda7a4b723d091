#!/usr/bin/env bash
# robosuite 1.5.2: orientation_error, the error that its operational-space controllers correct.
#
# Guess: as its docstring says, the axis times the angle.
# Seen:  the axis times the sine of the angle. For 90 degrees it is 1 instead of 1.57, for 150 degrees the
#        same as for 30, and for 180 degrees nothing: an arm half a turn from an absolute goal stays there,
#        and beyond 90 degrees it is pulled the less, the farther away it is. No warning.
#        (utils/control_utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from robosuite.utils.control_utils import orientation_error
from scipy.spatial.transform import Rotation

print(f"robosuite {version('robosuite')}: orientation error")
found = {}
for degrees in (10, 30, 90, 150, 179, 180):
    goal = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    found[degrees] = np.linalg.norm(orientation_error(goal, np.eye(3)))
    print(f"  {degrees} degrees = {np.radians(degrees):.3f}: {found[degrees]:.3f}")
for degrees, error in found.items():
    assert abs(error - np.sin(np.radians(degrees))) < 1e-6, found
PY
