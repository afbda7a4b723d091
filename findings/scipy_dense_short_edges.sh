#!/usr/bin/env bash
# scipy 1.17.1: shortest paths on a dense matrix of distances with a short edge.
#
# Guess: scipy.sparse.csgraph takes 0 in a dense matrix for "no edge", and any other finite number
#        for an edge of that length.
# Seen:  every entry below 1e-8 is "no edge" too: two points 9e-9 apart are infinitely far from each
#        other, and a path through close points takes a detour. No warning. The same numbers in a
#        sparse matrix are edges. Squared distances of points 1e-4 apart are already that short.
#
# Here: evaluation.paths gives csgraph a sparse matrix.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet scipy==1.17.1 numpy==2.4.0

"$folder/venv/bin/python" - <<'PY'
import numpy as np
import scipy
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra, johnson, shortest_path

seen = {}
for length in (2e-8, 9e-9):
    dense = np.array([[0, length], [length, 0]])
    for function in (dijkstra, johnson, shortest_path):
        there = function(dense)[0, 1], function(csr_array(dense))[0, 1]
        seen[function.__name__, length] = there
        print(f"scipy {scipy.__version__}, {function.__name__}, edge {length}: dense {there[0]}, sparse {there[1]}")
# Three points in a row, 1e-5 apart, edges of squared length; and a long edge past the middle one.
points = np.array([0.0, 1e-5, 2e-5])
squared = np.subtract.outer(points, points) ** 2
squared[0, 2] = squared[2, 0] = 1.0
detour = dijkstra(squared)[0, 2], dijkstra(csr_array(squared))[0, 2]
print(f"over the middle point: dense {detour[0]}, sparse {detour[1]}")
for (name, length), (dense, sparse) in seen.items():
    assert sparse == length, f"{name}: a sparse edge of {length} is {sparse}"
    assert (dense == np.inf) == (length < 1e-8), f"{name}: a dense edge of {length} is {dense}"
assert detour[0] == 1.0 and detour[1] < 1e-9, "the path over the middle point has changed"
PY
