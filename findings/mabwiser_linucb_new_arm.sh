#!/usr/bin/env bash
# mabwiser 2.7.4: LinUCB, contexts and an arm without data.
#
# Guess: with the ridge weight λ, A begins as λ I, so the bonus of an arm without data is α |x| / sqrt(λ): the
#        stronger the regularisation, the smaller.
# Seen:  the inverse of A begins as λ I. The bonus is α |x| sqrt(λ): with λ = 10 it is ten times too large,
#        with λ = 0.1 ten times too small. After the first row of an arm the inverse is right: its bonus
#        jumps. λ = 1, the default, is right. No warning. (_RidgeRegression.init in linear.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mabwiser==2.7.4 numpy==2.2.6 pandas==2.3.3 scikit-learn==1.7.2 scipy==1.15.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from mabwiser.mab import MAB, LearningPolicy

print(f"mabwiser {version('mabwiser')}: LinUCB, alpha 1, context 1, reward 0: the bonus of each arm")
found = {}
for weight in (0.1, 1.0, 10.0):
    bandit = MAB(["seen", "new"], LearningPolicy.LinUCB(alpha=1.0, l2_lambda=weight), seed=1)
    bandit.fit(["seen"], [0.0], [[1.0]])
    bonus = bandit.predict_expectations([[1.0]])
    expected = (1 / np.sqrt(weight + 1), 1 / np.sqrt(weight))
    found[weight] = (bonus["seen"], bonus["new"])
    print(
        f"  lambda {weight}: seen once {bonus['seen']:.3f} (expected {expected[0]:.3f}),"
        f" new {bonus['new']:.3f} (expected {expected[1]:.3f})"
    )
    assert abs(bonus["seen"] - expected[0]) < 1e-3, found
    assert abs(bonus["new"] - np.sqrt(weight)) < 1e-3, found
PY
