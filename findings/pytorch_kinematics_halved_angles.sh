#!/usr/bin/env bash
# pytorch_kinematics 0.10.0: quaternion_from_euler.
#
# Guess: it returns a quaternion and leaves the angles as they are.
# Seen:  the caller's angles are halved in place: a second call with them gives half of the rotation. No
#        warning. (transforms/rotation_conversions.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pytorch-kinematics==0.10.0 torch==2.13.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import pytorch_kinematics
import torch

angles = torch.tensor([0.0, 0.0, 1.0])
found = []
print(f"pytorch_kinematics {version('pytorch_kinematics')}: angles before, the quaternion's turn, angles after")
for _ in range(3):
    before = angles.tolist()
    quaternion = pytorch_kinematics.quaternion_from_euler(angles)
    turn = 2 * torch.atan2(quaternion[3], quaternion[0]).item()
    found.append((turn, angles.tolist()))
    print(f"  {before}: {turn:.3f}, {angles.tolist()}")
assert [after[2] for _, after in found] == [0.5, 0.25, 0.125], found
assert all(abs(turn - 0.5**i) < 1e-5 for i, (turn, _) in enumerate(found)), found
PY
