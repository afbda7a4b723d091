#!/usr/bin/env bash
# rliable 1.2.0: metrics.aggregate_iqm of three scores, as of three seeds of one task.
#
# Guess: the mean of the middle half of [0, 0, 9]: the largest score counts half at most, 1.5.
# Seen:  3.0, the plain mean: as many scores are cut as a quarter of their number rounds down to, which is
#        none. With five, a fifth on each side. No warning. (metrics.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps rliable==1.2.0 numpy==2.4.6 scipy==1.17.1 arch==8.0.0 absl-py==2.3.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from rliable import metrics

found = {}
for scores in ([0.0, 0.0, 9.0], [0.0, 0.0, 0.0, 9.0]):
    array = np.array(scores).reshape(-1, 1)
    found[len(scores)] = float(metrics.aggregate_iqm(array)), float(metrics.aggregate_mean(array))
    print(f"rliable {version('rliable')}, {scores}: IQM {found[len(scores)][0]}, mean {found[len(scores)][1]}")
assert found[3] == (3.0, 3.0) and found[4][0] == 0.0, found
PY
