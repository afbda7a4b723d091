#!/usr/bin/env bash
# robosuite 1.5.2: UniformRandomSampler(rotation_axis="z") for an object that has an initial rotation, a
# hammer.
#
# Guess: as its page says, rotation_axis is the axis about which the object is turned: a hammer that lies on
#        the table points in all directions.
# Seen:  it is rolled about its own handle and always points the same way. With rotation_axis="y" it turns
#        about z. The sampled quaternion has its real part first and the object's has it last, and their
#        product takes both for the latter. Objects without an initial rotation are right. No warning.
#        (utils/placement_samplers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from robosuite.models.objects import BoxObject, HammerObject
from robosuite.utils.placement_samplers import UniformRandomSampler
from scipy.spatial.transform import Rotation


def turned(thing, own_axis, angle, axis):
    """Where an axis of the object points after the sampler has turned it."""
    sampler = UniformRandomSampler(
        "sampler", thing, rotation=angle, rotation_axis=axis, ensure_object_boundary_in_range=False
    )
    _, quaternion, _ = sampler.sample()[thing.name]
    return Rotation.from_quat(np.roll(quaternion, -1)).apply(own_axis)


print(f"robosuite {version('robosuite')}: direction of the handle, turned by 0 and 90 degrees")
found = {}
for axis in ("z", "y"):
    found[axis] = [turned(HammerObject("hammer"), [0, 0, 1], angle, axis) for angle in (0.0, np.pi / 2)]
    print(f"  hammer, about {axis}: {found[axis][0].round(2) + 0.0}, {found[axis][1].round(2) + 0.0}")
box = turned(BoxObject("box", size=[0.1, 0.02, 0.02]), [1, 0, 0], np.pi / 2, "z")
print(f"  box, about z: [1 0 0], {box.round(2) + 0.0}")
assert np.allclose(np.abs(box), [0, 1, 0], atol=1e-5), box
assert np.allclose(found["z"][0], found["z"][1], atol=1e-4), found  # expected: at a right angle
assert abs(found["y"][0] @ found["y"][1]) < 1e-4 and abs(found["y"][1][2]) < 1e-4, found
PY
