#!/usr/bin/env bash
# ikpy 4.2.1: a chain from a MuJoCo model, Chain.from_mjcf_file.
#
# Guess: the joints of MuJoCo: without an axis in the file it is z, and ranges in degrees, MuJoCo's unit,
#        become radians.
# Seen:  the default axis is y: a link along x that is turned by 90 degrees points down instead of along y. A
#        range of a default class stays in degrees: bounds of (-90, 90) radians, which limit nothing. A range
#        at the joint itself is converted. No warning. (mjcf/MJCF.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ikpy==4.2.1 mujoco==3.8.1 numpy==2.2.6 scipy==1.15.3

cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import mujoco
import numpy as np
from ikpy.chain import Chain

MODEL = """<mujoco><default><default class="arm"><joint range="-90 90"/></default></default>
<worldbody><body name="a"><joint name="j" {joint}/><geom size=".1"/>
<body name="b" pos="1 0 0"><geom size=".1"/></body></body></worldbody></mujoco>"""

print(f"ikpy {version('ikpy')}: the end of a link along x, turned by 90 degrees, and the joint's bounds")
found = {}
for joint in ('class="arm"', 'class="arm" axis="0 0 1"', 'range="-90 90" axis="0 0 1"'):
    with open("model.xml", "w") as file:
        file.write(MODEL.format(joint=joint))
    chain = Chain.from_mjcf_file("model.xml")
    end = chain.forward_kinematics([0, np.pi / 2, 0])[:3, 3]
    model = mujoco.MjModel.from_xml_path("model.xml")
    data = mujoco.MjData(model)
    data.qpos[0] = np.pi / 2
    mujoco.mj_kinematics(model, data)
    bounds = tuple(round(float(each), 3) for each in chain.links[1].bounds)
    found[joint] = (end, data.body("b").xpos.copy(), bounds)
    print(f"  {joint}: {end.round(3) + 0.0}, {bounds}; MuJoCo {found[joint][1].round(3) + 0.0}, {model.jnt_range[0].round(3)}")
first, second, third = found.values()
assert np.allclose(first[0], [0, 0, -1]) and np.allclose(first[1], [0, 1, 0]), found
assert np.allclose(second[0], second[1]) and first[2] == second[2] == (-90, 90), found
assert third[2] == (-1.571, 1.571), found
PY
