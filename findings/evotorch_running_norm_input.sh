#!/usr/bin/env bash
# evotorch 0.6.1: RunningNorm.update(observation), which collects mean and deviation.
#
# Guess: the observation is only read.
# Seen:  the first array becomes the running sum itself, without a copy, and each further update adds to
#        it: an observation that an agent or a buffer still uses grows. (neuroevolution/net/runningnorm.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==2.4.6 evotorch==0.6.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from evotorch.neuroevolution.net.runningnorm import RunningNorm

norm = RunningNorm(shape=3, dtype="float32")
first = np.array([1.0, 2.0, 3.0], np.float32)
norm.update(first)
norm.update(np.array([10.0, 20.0, 30.0], np.float32))
print(f"evotorch {version('evotorch')}: the first observation, [1, 2, 3], after a second update: {first.tolist()}")
assert first.tolist() == [11.0, 22.0, 33.0], first
PY
