#!/usr/bin/env bash
# pyquaternion 0.9.9: Quaternion.integrate(rate, dt).
#
# Guess: the rates are 'about the global x, y and z axes', as the documentation says.
# Seen:  they are about the axes of the body. After a quarter turn about x, a quarter turn about z takes y
#        to -x instead of z. (derivative and integrate in quaternion.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyquaternion==0.9.9 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from pyquaternion import Quaternion

rotation = Quaternion(axis=[1, 0, 0], degrees=90)
wanted = (Quaternion(axis=[0, 0, 1], degrees=90) * rotation).rotate(np.array([0.0, 1.0, 0.0]))
rotation.integrate([0.0, 0.0, np.pi / 2], 1.0)
found = rotation.rotate(np.array([0.0, 1.0, 0.0]))
print(f"pyquaternion {version('pyquaternion')}: y goes to {np.round(found, 3).tolist()}; about the global z: {np.round(wanted, 3).tolist()}")
assert np.allclose(found, [-1, 0, 0], atol=1e-6) and np.allclose(wanted, [0, 0, 1], atol=1e-6)
PY
