#!/usr/bin/env bash
# scope-rl 0.2.1: confidence intervals of off-policy evaluation.
#
# Guess: the interval by Hoeffding's inequality narrows with the number of trajectories, as its docstring
#        prints it; one by the t-test covers the mean in 95% of the cases with alpha=0.05.
# Seen:  the first is multiplied by the root of n, where it is to be divided: for values between 0 and 1,
#        +-0.14 for 100 trajectories is 14, and +-0.014 for 10,000 is 136. It widens with the data. The
#        second covers the mean in 90%: alpha is used up on each side. No warning. (utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==1.26.4 scipy==1.13.1 scikit-learn==1.5.2 \
  gym==0.26.2 pandas==2.2.3
"$folder/venv/bin/pip" install --quiet --no-deps scope-rl==0.2.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from scope_rl.utils import (
    estimate_confidence_interval_by_hoeffding,
    estimate_confidence_interval_by_t_test,
)

rng = np.random.default_rng(0)


def bounds(estimate, values):
    mean, low, high = list(estimate(values, alpha=0.05).values())
    assert abs(mean - values.mean()) < 1e-9
    return low, high


print(f"scope-rl {version('scope-rl')}: half of the width by Hoeffding's inequality")
widths = {}
for number in (100, 10_000):
    values = rng.uniform(0, 1, number)
    low, high = bounds(estimate_confidence_interval_by_hoeffding, values)
    widths[number] = (high - low) / 2
    right = values.max() * np.sqrt(np.log(2 / 0.05) / (2 * number))
    print(f"  {number} values: {widths[number]:.3g}, as the docstring has it {right:.3g}")
assert widths[10_000] > 9 * widths[100] > 100, widths

hits = 0
for _ in range(4000):
    low, high = bounds(estimate_confidence_interval_by_t_test, rng.normal(size=20))
    hits += low <= 0 <= high
print(f"  intervals by the t-test with alpha 0.05 cover the mean in {hits / 4000:.1%}")
assert 0.88 < hits / 4000 < 0.92, hits
PY
