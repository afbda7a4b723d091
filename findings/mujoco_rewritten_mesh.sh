#!/usr/bin/env bash
# mujoco 3.8.1: a mesh file that is written again, as scripts do that randomise shapes.
#
# Guess: MjModel.from_xml_string reads the files that the model names, so the second model has the
#        second mesh.
# Seen:  it has the first one, with its mass, if the file was written again in the same second. Meshes
#        are kept in the process (up to 500 MB, on by default) by the file's name and its time in
#        whole seconds; size and content are not compared. A second later the mesh is read again.
#        After mj_setCacheCapacity(mj_getCache(), 0) every model has its own mesh. No warning. 4.0.0
#        does the same.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.8.1

"$folder/venv/bin/python" - "$folder/box.obj" <<'PY'
import os
import sys
from itertools import product

import mujoco

path = sys.argv[1]
FACES = "132 234 567 687 125 265 374 478 153 357 246 486"
MODEL = f"""<mujoco><asset><mesh name="box" file="{path}"/></asset>
  <worldbody><body><freejoint/><geom type="mesh" mesh="box"/></body></worldbody></mujoco>"""


def mass_of_box(half, second):
    """Writes a box of a half width [m] at a time [s], and compiles a model of it: its mass [kg]."""
    corners = [" ".join(map(str, corner)) for corner in product((-half, half), repeat=3)]
    with open(path, "w") as file:
        file.writelines(f"v {corner}\n" for corner in corners)
        file.writelines(f"f {' '.join(face)}\n" for face in FACES.split())
    os.utime(path, (second, second))  # as if it were written then
    return round(float(mujoco.MjModel.from_xml_string(MODEL).body_mass[1]), 3)


print(f"mujoco {mujoco.__version__}, mass of a box of 0.2 m, then of 0.4 m:")
first, same_second, later = (
    mass_of_box(0.1, 1_700_000_000.1),
    mass_of_box(0.2, 1_700_000_000.9),
    mass_of_box(0.2, 1_700_000_001.1),
)
print(f"  {first} kg, then {same_second} kg in the same second and {later} kg in the next")
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)
without = [mass_of_box(half, 1_700_000_001.2) for half in (0.1, 0.2)]
print(f"  without its cache {without[0]} kg, then {without[1]} kg")
assert (first, same_second, later) == (8.0, 8.0, 64.0) and without == [8.0, 64.0], "read again"
PY
