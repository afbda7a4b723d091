#!/usr/bin/env bash
# ahrs 0.4.0: QuaternionArray.average(weights=[1, 2]) of 0 and 90 degrees about z.
#
# Guess: 63.4 degrees, the weighted mean of the docstring's formula, as scipy's Rotation.mean gives.
# Seen:  76.0 degrees: the weights are squared. (common/quaternion.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ahrs==0.4.0 numpy==2.4.6 scipy==1.17.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from ahrs import QuaternionArray
from scipy.spatial.transform import Rotation

half = np.sqrt(0.5)
both = np.array([[1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half]])
mean = np.asarray(QuaternionArray(both).average(weights=np.array([1.0, 2.0])))
found = 2 * np.degrees(np.arctan2(abs(mean[3]), abs(mean[0])))
wanted = np.degrees(Rotation.from_euler("z", [[0.0], [90.0]], degrees=True).mean(weights=[1, 2]).magnitude())
print(f"ahrs {version('ahrs')}: {found:.2f} degrees; scipy: {wanted:.2f}")
assert abs(wanted - 63.43) < 0.01 and abs(found - 75.96) < 0.01, (found, wanted)
PY
