#!/usr/bin/env bash
# mujoco 3.8.1: MjModel.from_xml_string(xml, assets) with the content of a mesh, given as bytes.
#
# Guess: the model has the mesh that was given.
# Seen:  it may have an earlier one of the same name: MuJoCo keeps compiled meshes in the process, and
#        compares a checksum that does not see every difference. Boxes written as text with the half
#        widths 0.2 and 0.3, or 0.12 and 0.13, count as equal, and so do a quarter of random pairs of
#        two digits. (Those of 0.1 and 0.2, and all pairs with 16 digits, do not.) With a name that
#        depends on the content, or after mj_setCacheCapacity(mj_getCache(), 0), all are right. No
#        warning. 4.0.0 is right.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.8.1

"$folder/venv/bin/python" - <<'PY'
import random
from itertools import count, product

import mujoco

FACES = "132 234 567 687 125 265 374 478 153 357 246 486"
names = count()


def box(half):
    """A box of a half width [m] as OBJ text."""
    lines = [f"v {' '.join(map(str, corner))}" for corner in product((-half, half), repeat=3)]
    return "\n".join([*lines, *(f"f {' '.join(face)}" for face in FACES.split())]).encode()


def mass(name, half):
    """The mass [kg] of the box in a model that gets it under a name."""
    xml = f"""<mujoco><asset><mesh name="box" file="{name}"/></asset><worldbody><body>
      <freejoint/><geom type="mesh" mesh="box"/></body></worldbody></mujoco>"""
    return round(float(mujoco.MjModel.from_xml_string(xml, {name: box(half)}).body_mass[1]), 3)


def masses(*halves):
    """Masses of boxes that have one name, one after the other."""
    name = f"{next(names)}.obj"
    return [mass(name, half) for half in halves]


def right(half):
    return round(1000 * (2 * half) ** 3, 3)


def stale(digits, pairs=200):
    """How many second boxes of random pairs are not those that were given."""
    draw = random.Random(0).uniform
    sizes = [(round(draw(0.05, 0.5), digits), round(draw(0.05, 0.5), digits)) for _ in range(pairs)]
    return sum(abs(masses(a, b)[1] - right(b)) > 0.002 for a, b in sizes)


few, many = stale(2), stale(16)
found = masses(0.2, 0.3)
print(f"mujoco {mujoco.__version__}: boxes of 0.4 and 0.6 m under one name weigh {found} kg;", end=" ")
print(f"right: {[right(0.2), right(0.3)]}")
print(f"  the second box is the first one in {few} of 200 pairs with two digits,", end=" ")
print(f"in {many} of 200 with 16")
assert found == [64.0, 64.0] and few > 20 and many == 0, "other boxes now"
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)
print(f"  without the cache they weigh {masses(0.2, 0.3)} kg")
assert masses(0.2, 0.3) == [64.0, 216.0] and stale(2) == 0
PY
