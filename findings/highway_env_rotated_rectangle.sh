#!/usr/bin/env bash
# highway-env 1.12.1: utils.point_in_rotated_rectangle, and rotated_rectangles_intersect.
#
# Guess: a point on the long axis of a turned rectangle is inside.
# Seen:  the point is turned by the angle instead of back, so the mirrored rectangle is tested: (3, 3) is
#        outside one of length 10 at 45 degrees, and (3, -3) is inside. rect_corners gives the right
#        corners. Who yields at a crossing is decided by it. (utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet highway-env==1.12.1 gymnasium==1.4.0 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from highway_env import utils

origin, seen = np.zeros(2), {}
for point in ((3.0, 3.0), (3.0, -3.0)):
    inside = utils.point_in_rotated_rectangle(np.array(point), origin, 10, 1, np.pi / 4)
    meets = utils.rotated_rectangles_intersect((origin, 10, 1, np.pi / 4), (np.array(point), 0.5, 0.5, 0.0))
    seen[point] = bool(inside), bool(meets)
    print(f"highway-env {version('highway-env')}, 10 x 1 at 45 degrees, {point}: inside {seen[point][0]}, a small square meets it {seen[point][1]}")
corners = np.round(utils.rect_corners(origin, 10, 1, np.pi / 4), 1).tolist()
print(f"  corners {corners}")
assert seen[3.0, 3.0][0] is False and seen[3.0, -3.0][0] is True, seen
PY
