#!/usr/bin/env bash
# ahrs 0.4.0: chiaverini(matrix), the quaternion of a half turn about x.
#
# Guess: [0, 1, 0, 0]; the docstring defines the sign of 0 as 1.
# Seen:  [1, 0, 0, 0], no rotation at all: numpy's sign of 0 is 0, so all three components vanish.
#        (common/orientation.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ahrs==0.4.0 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from ahrs.common.orientation import chiaverini

found = np.asarray(chiaverini(np.diag([1.0, -1.0, -1.0])))
print(f"ahrs {version('ahrs')}: {np.round(found, 3).tolist()}")
assert np.allclose(np.abs(found), [1, 0, 0, 0]), found
PY
