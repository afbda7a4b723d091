#!/usr/bin/env bash
# pytorch_kinematics 0.10.0: a chain from a MuJoCo model.
#
# Guess: the positions that MuJoCo gives, and a joint without limits may turn.
# Seen:  a joint whose axis does not go through its body's origin moves the body and all that hangs on it:
#        with the joint at z = -0.3 the hand is at z = 0.7 instead of 1, at angle 0. A joint without a range
#        gets the limits 0 and 0: clamp() returns 0, and inverse kinematics, which keeps limits by default,
#        does not move it. No warning. (mjcf.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pytorch-kinematics==0.10.0 torch==2.13.0 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import mujoco
import pytorch_kinematics
import torch

MODEL = """<mujoco><worldbody><body name="arm" pos="0 0 1">
<joint name="j" axis="0 1 0" pos="0 0 {height}"/><geom size=".1"/>
<body name="hand" pos="1 0 0"><geom size=".1"/></body></body></worldbody></mujoco>"""

print(f"pytorch_kinematics {version('pytorch_kinematics')}: position of the hand at angle 0")
found = {}
for height in (0, -0.3):
    text = MODEL.format(height=height)
    chain = pytorch_kinematics.build_chain_from_mjcf(text)
    hand = chain.forward_kinematics(torch.zeros(1, 1))["hand"].get_matrix()[0, :3, 3]
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    clamped = chain.clamp(torch.ones(1, 1)).item()
    found[height] = (hand, data.body("hand").xpos.tolist(), clamped)
    print(f"  joint at z = {height}: {[round(each, 3) for each in hand.tolist()]}, MuJoCo {found[height][1]}; an angle of 1 clamped: {clamped}")
assert torch.allclose(found[0][0], torch.tensor(found[0][1]).float(), atol=1e-5), found
assert torch.allclose(found[-0.3][0], torch.tensor([1.0, 0.0, 0.7]), atol=1e-5), found
assert found[-0.3][1] == [1.0, 0.0, 1.0] and found[0][2] == found[-0.3][2] == 0.0, found
PY
