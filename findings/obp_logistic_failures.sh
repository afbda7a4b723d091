#!/usr/bin/env bash
# obp 0.4.1 (Open Bandit Pipeline): LogisticEpsilonGreedy and rewards of 0 and 1.
#
# Guess: an arm that fails 1,000 times is thought bad.
# Seen:  its probability of success stays 0.5. The loss is written for rewards of -1 and 1, so a reward of 0
#        has no gradient: only successes teach. An arm that succeeds in one of ten cases is as good as one
#        that succeeds always. The docstrings of update_params name the reward without a range, and obp's own
#        data have 0 and 1. No warning. (policy/logistic.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==1.26.4 pandas==1.5.3 scikit-learn==1.3.2 scipy==1.12.0 obp==0.4.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from obp.policy import LogisticEpsilonGreedy

rng = np.random.default_rng(0)
print(f"obp {version('obp')}: what an arm is thought to be worth after 1,000 rows")
found = {}
for share in (0.0, 0.1, 0.5, 1.0):
    policy = LogisticEpsilonGreedy(dim=1, n_actions=2, random_state=0)
    for row in range(1000):
        policy.update_params(action=0, reward=int(rng.random() < share), context=np.ones((1, 1)))
    found[share] = float(np.asarray(policy.model_list[0].predict_proba(np.ones((1, 1)))).ravel()[0])
    print(f"  successes {share:.0%}: {found[share]:.3f}")
assert found[0.0] == 0.5, found
assert found[0.1] > 0.7, found
PY
