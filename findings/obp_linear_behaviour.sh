#!/usr/bin/env bash
# obp 0.4.1 (Open Bandit Pipeline): linear_behavior_policy for synthetic data.
#
# Guess: as its docstring says, a "linear contextual behavior policy": which action is likely depends on the
#        context.
# Seen:  all contexts have the same probabilities. What depends on the context is added to every action alike,
#        and the softmax cancels it. Estimators that are tested on such data never meet logging that depends
#        on the context. No warning. (dataset/synthetic.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==1.26.4 pandas==1.5.3 scikit-learn==1.3.2 scipy==1.12.0 obp==0.4.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from obp.dataset import SyntheticBanditDataset, linear_behavior_policy

data = SyntheticBanditDataset(
    n_actions=5, dim_context=3, behavior_policy_function=linear_behavior_policy, random_state=1
)
batch = data.obtain_batch_bandit_feedback(1000)
probabilities = linear_behavior_policy(batch["context"], data.action_context, random_state=1)
spread = float(np.ptp(probabilities, axis=0).max())
print(f"obp {version('obp')}: probabilities of five actions in the first two of 1,000 contexts")
for row in probabilities[:2]:
    print(f"  {np.asarray(row).ravel().round(4)}")
print(f"  largest difference over all contexts: {spread:.1e}; between actions: {np.ptp(probabilities[0]):.3f}")
assert np.ptp(batch["context"], axis=0).min() > 3
assert spread < 1e-6 and np.ptp(probabilities[0]) > 0.01
PY
