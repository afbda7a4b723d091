#!/usr/bin/env bash
# robosuite 1.5.2: transform_from_pixels_to_world for pixels in the last row or column of an image.
#
# Guess: the point in the world, as for other pixels.
# Seen:  the position of the camera. The depth of these pixels is interpolated between the pixel and itself
#        with the weights 0 and 0, so that it is 0. All other pixels are right. No warning.
#        (bilinear_interpolate in utils/camera_utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1 h5py==3.16.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from robosuite.utils.camera_utils import transform_from_pixels_to_world

SIZE = 8
depth = np.full((SIZE, SIZE, 1), 2.0)
# A camera at (5, 6, 7) whose pixels are numbers: x = column * depth, y = row * depth, z = depth.
to_world = np.eye(4)
to_world[:3, 3] = [5.0, 6.0, 7.0]
print(f"robosuite {version('robosuite')}: points of pixels (row, column), all 2 m from the camera at (5, 6, 7)")
found = {}
for pixel in ((3, 3), (6, 6), (7, 3), (3, 7), (7, 7)):
    point = transform_from_pixels_to_world(np.array(pixel, dtype=float), depth, to_world)
    expected = to_world[:3, 3] + 2.0 * np.array([pixel[1], pixel[0], 1.0])
    found[pixel] = (point, expected)
    print(f"  {pixel}: {point}, expected {expected}")
for pixel, (point, expected) in found.items():
    if max(pixel) == SIZE - 1:
        assert np.allclose(point, [5, 6, 7]), found
    else:
        assert np.allclose(point, expected), found
PY
