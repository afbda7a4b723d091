#!/usr/bin/env bash
# robosuite 1.5.2: mat2euler(euler2mat(angles)).
#
# Guess: the angles again: both pages say (r, p, y).
# Seen:  other angles as soon as two of them are not 0. euler2mat multiplies the turns in one order, and
#        mat2euler's default takes them in the other. mat2euler(matrix, axes="rxyz") gives the angles again.
#        Each is right alone, so that tests about one axis pass. No warning. (utils/transform_utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from robosuite.utils.transform_utils import euler2mat, mat2euler

print(f"robosuite {version('robosuite')}: angles, mat2euler(euler2mat(angles)), the same with axes='rxyz'")
found = []
for angles in ([0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.5, 0.5, 0.0], [0.1, 0.5, 1.0]):
    matrix = euler2mat(np.array(angles))
    plain, other = mat2euler(matrix), mat2euler(matrix, axes="rxyz")
    found.append((np.abs(plain - angles).max(), np.abs(other - angles).max()))
    print(f"  {angles}: {plain.round(3) + 0.0}, {other.round(3) + 0.0}")
assert all(other < 1e-5 for _, other in found), found
assert [difference > 0.05 for difference, _ in found] == [False, False, True, True], found
PY
