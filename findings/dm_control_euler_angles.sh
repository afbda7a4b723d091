#!/usr/bin/env bash
# dm_control 1.0.50: transformations.rmat_to_euler, and euler_to_rmat back.
#
# Guess: the matrix comes back, also at a pitch of 90 degrees, where one of many triples is chosen.
# Seen:  order 'XYX' turns a rotation about x into the opposite one, without a warning. At -90 degrees,
#        'ZYX' gives angles that are half a turn off, where a line is logged and no error raised.
#        (utils/transformations.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet dm_control==1.0.50 mujoco==4.0.0 numpy==2.4.6

MUJOCO_GL=disable "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from dm_control.utils import transformations

given = {
    ("XYX", "0.5 rad about x"): transformations.rotation_x_axis(np.array([0.5])),
    ("XYX", "0.5, 0.3, 0.2"): transformations.euler_to_rmat(np.array([0.5, 0.3, 0.2]), "XYX"),
    ("ZYX", "pitch -90 degrees"): transformations.euler_to_rmat(np.array([0.0, -np.pi / 2, 0.2]), "ZYX"),
}
found = {}
for (order, name), matrix in given.items():
    matrix = np.asarray(matrix)[:3, :3]
    angles = transformations.rmat_to_euler(matrix, order)
    back = transformations.euler_to_rmat(np.asarray(angles), order)
    found[order, name] = float(np.abs(back - matrix).max())
    print(f"dm_control {version('dm_control')}, {order}, {name}: largest error of the matrix {found[order, name]:.3f}")
wrong, right, half = found.values()
assert wrong > 0.5 and right < 1e-6 and half > 0.5, found
PY
