#!/usr/bin/env bash
# ahrs 0.4.0: Quaternion ** 0.5.
#
# Guess: half the rotation, as the docstring's formula says: of a quarter turn, an eighth of a turn.
# Seen:  numbers that are no rotation: the exponential is taken of each component on its own.
#        (common/quaternion.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ahrs==0.4.0 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from ahrs import Quaternion

half = np.sqrt(0.5)
found = np.asarray(Quaternion([half, 0.0, 0.0, half]) ** 0.5, float)
wanted = [np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)]
print(f"ahrs {version('ahrs')}: {np.round(found, 3).tolist()}, half of the rotation is {np.round(wanted, 3).tolist()}")
assert not np.allclose(found, wanted, atol=0.05), found
PY
