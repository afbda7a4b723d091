#!/usr/bin/env bash
# mabwiser 2.7.4: Popularity, a policy for bandits, fitted in two parts.
#
# Guess: as its docstring says, an arm is chosen with its mean reward over the sum of the means: fit() and
#        then partial_fit() with the rest of the data give what one fit() with all of it gives.
# Seen:  arms in the second part have their mean again, the others keep a probability, and both are normalised
#        together. With equal rewards, arm A of which one more row was seen is chosen in 98% of the cases if
#        rewards are 20, in 4% if they are 0.02, instead of in half of them. No warning.
#        (_Popularity.partial_fit in popularity.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mabwiser==2.7.4 numpy==2.2.6 pandas==2.3.3 scikit-learn==1.7.2 scipy==1.15.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from mabwiser.mab import MAB, LearningPolicy


def share(bandit):
    return float(np.mean([bandit.predict() == "A" for _ in range(4000)]))


print(f"mabwiser {version('mabwiser')}: share of arm A, whose rewards are those of arm B")
found = {}
for reward in (20.0, 0.02):
    once = MAB(["A", "B"], LearningPolicy.Popularity(), seed=1)
    once.fit(["A", "B", "A"], [reward] * 3)
    twice = MAB(["A", "B"], LearningPolicy.Popularity(), seed=1)
    twice.fit(["A", "B"], [reward] * 2)
    twice.partial_fit(["A"], [reward])
    found[reward] = (share(once), share(twice))
    print(f"  rewards {reward}: one fit {found[reward][0]:.2f}, in two parts {found[reward][1]:.2f}")
assert all(abs(once - 0.5) < 0.05 for once, _ in found.values()), found
assert found[20.0][1] > 0.95 and found[0.02][1] < 0.1, found
PY
