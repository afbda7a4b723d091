#!/usr/bin/env bash
# gymnasium-robotics 1.4.2: rotations.point_quat2quat, which makes a rotation about z of a rotation vector's
# parts.
#
# Guess: point_quat2quat(quat2point_quat(q)) is q, for rotations about z by any angle.
# Seen:  beyond 90 degrees it is another one: 120 degrees come back as -60. The angle is taken by an
#        arctangent of the quotient, which has forgotten the quadrant. No warning. (utils/rotations.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium-robotics==1.4.2 gymnasium==1.4.0 mujoco==3.3.0 numpy==2.2.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from gymnasium_robotics.utils.rotations import point_quat2quat, quat2point_quat

print(f"gymnasium-robotics {version('gymnasium-robotics')}: angle about z before and after")
found = {}
for degrees in (30, 80, 120, 170):
    half = np.radians(degrees) / 2
    quaternion = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    back = point_quat2quat(quat2point_quat(quaternion))[0]
    found[degrees] = float(np.degrees(2 * np.arctan2(back[3], back[0])))
    print(f"  {degrees}: {found[degrees]:.1f}")
assert all(abs(found[degrees] - degrees) < 1e-3 for degrees in (30, 80)), found
assert all(abs(found[degrees] - (degrees - 180)) < 1e-3 for degrees in (120, 170)), found
PY
