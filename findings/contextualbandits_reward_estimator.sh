#!/usr/bin/env bash
# contextualbandits 0.3.30: evaluateDoublyRobust, called three times with the same arguments.
#
# Guess: the same estimate three times.
# Seen:  the array with the estimated rewards that the caller passes is changed by each call, so each
#        estimate is another one. (evaluation.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet contextualbandits==0.3.30

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from contextualbandits.evaluation import evaluateDoublyRobust

estimates = np.full((4, 2), 0.5)
found = [
    float(
        evaluateDoublyRobust(
            pred=np.zeros(4, int),
            X=np.zeros((4, 1)),
            a=np.array([0, 0, 1, 1]),
            r=np.ones(4),
            p=np.full(4, 0.5),
            reward_estimator=estimates,
        )
    )
    for _ in range(3)
]
print(f"contextualbandits {version('contextualbandits')}: {found}; the caller's estimates are now {np.unique(estimates).tolist()}")
assert found[0] != found[1] and not (estimates == 0.5).all(), found
PY
