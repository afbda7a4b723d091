#!/usr/bin/env bash
# filterpy 2.0.0: monte_carlo.residual_resample of weights [0.4, 0.4, 0.1, 0.1].
#
# Guess: each particle is drawn in proportion to its weight on average.
# Seen:  particles of small weight are never drawn: what is left of a weight is computed from the weight
#        and not from N times the weight. (monte_carlo/resampling.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet filterpy==2.0.0 numpy==2.4.6 scipy==1.17.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from filterpy.monte_carlo import residual_resample

np.random.seed(0)
weights = np.array([0.4, 0.4, 0.1, 0.1])
drawn = np.concatenate([residual_resample(weights) for _ in range(2000)])
share = np.bincount(drawn, minlength=4) / len(drawn)
print(f"filterpy {version('filterpy')}: weights {weights.tolist()}, drawn {np.round(share, 3).tolist()}")
assert (share[2:] < 0.02).all(), share
PY
