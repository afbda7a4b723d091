#!/usr/bin/env bash
# spatialmath-python 1.1.18: wrap_mpi2_pi2, project and qangle of spatialmath.base.
#
# Guess: as their pages say, an angle wrapped to [-pi/2, pi/2]; the projection of one vector onto another; the
#        smallest rotation between two quaternions.
# Seen:  wrap_mpi2_pi2(3.5) is -2.783, outside the range. project([1, 0, 0], [2, 0, 0]) is [4, 0, 0]: the
#        square of the length is not divided by, and orthogonalize gives a vector that is not orthogonal.
#        qangle(q, -q) is 6.283, although both are one rotation. No warnings. (base/vectors.py,
#        base/quaternions.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet spatialmath-python==1.1.18 numpy==2.2.6 scipy==1.15.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from spatialmath import base

wrapped = float(base.wrap_mpi2_pi2(3.5))
onto = base.project(np.array([1.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]))
rest = base.orthogonalize(np.array([1.0, 1.0, 0.0]), np.array([2.0, 0.0, 0.0]))
quaternion = np.array([0.6, 0.8, 0.0, 0.0])
between = float(base.qangle(quaternion, -quaternion))
print(f"spatialmath-python {version('spatialmath-python')}")
print(f"  wrap_mpi2_pi2(3.5): {wrapped:.3f}")
print(f"  project([1, 0, 0], [2, 0, 0]): {onto}")
print(f"  orthogonalize([1, 1, 0], [2, 0, 0]): {rest}")
print(f"  qangle(q, -q): {between:.3f}")
assert abs(wrapped) > np.pi / 2 and abs(wrapped - (3.5 - 2 * np.pi)) < 1e-3
assert np.allclose(onto, [4, 0, 0])
assert abs(np.dot(rest, [2, 0, 0])) > 1
assert abs(between - 2 * np.pi) < 1e-3
PY
