#!/usr/bin/env bash
# ikpy 4.2.1: inverse_kinematics(regularization_parameter=...).
#
# Guess: a penalty on the distance of the joints from their initial position, which chooses among the
#        solutions.
# Seen:  the parameter times this distance is added to each coordinate of the error. Where a solution of the
#        shifted equations exists, the end misses its target by exactly as much along x, y and z, and nothing
#        pulls the joints towards their start. With 0, the target is reached. No warning.
#        (inverse_kinematics.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ikpy==4.2.1 numpy==2.2.6 scipy==1.15.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from ikpy.chain import Chain
from ikpy.link import OriginLink, URDFLink

origin, up = [0, 0, 0], [0, 0, 1]
chain = Chain(
    [
        OriginLink(),
        URDFLink("a", origin, origin, rotation=up),
        URDFLink("b", up, origin, rotation=[0, 1, 0]),
        URDFLink("c", up, origin, rotation=[0, 1, 0]),
        URDFLink("tip", up, origin, joint_type="fixed"),
    ],
    active_links_mask=[False, True, True, True, False],
)
start = np.array([0, 0.3, 0.5, 0.7, 0])
target = chain.forward_kinematics([0, 0.9, 0.8, 1.0, 0])[:3, 3]
print(f"ikpy {version('ikpy')}: where the tip misses its target, by x, y, z")
found = {}
for weight in (0.0, 0.02, 0.05):
    joints = chain.inverse_kinematics(
        target, initial_position=start, regularization_parameter=weight or None
    )
    missed = chain.forward_kinematics(joints)[:3, 3] - target
    expected = -weight * np.linalg.norm(joints - start)
    found[weight] = (missed, expected)
    print(f"  {weight}: {missed.round(4) + 0.0}; minus the parameter times the distance: {expected:.4f}")
assert np.allclose(found[0.0][0], 0, atol=1e-3), found
for weight in (0.02, 0.05):
    missed, expected = found[weight]
    assert abs(expected) > 0.005 and np.allclose(missed, expected, atol=2e-3), found
PY
