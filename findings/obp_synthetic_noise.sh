#!/usr/bin/env bash
# obp 0.4.1 (Open Bandit Pipeline): rewards of SyntheticBanditDataset(reward_type="continuous").
#
# Guess: each batch of feedback has noise of its own, also those for training and for evaluation.
# Seen:  the noise is drawn with the same seed at every call. Row by row, two batches have almost the same
#        noise (correlation 0.99), and sample_reward of one action gives one number however often it is
#        called. So a second batch is no independent sample. No warning. (dataset/synthetic.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==1.26.4 pandas==1.5.3 scikit-learn==1.3.2 scipy==1.12.0 obp==0.4.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from obp.dataset import SyntheticBanditDataset

data = SyntheticBanditDataset(n_actions=5, dim_context=3, reward_type="continuous", random_state=1)
first, second = data.obtain_batch_bandit_feedback(1000), data.obtain_batch_bandit_feedback(1000)
rows = np.arange(1000)
noise = [
    batch["reward"] - batch["expected_reward"][rows, batch["action"]] for batch in (first, second)
]
correlation = float(np.corrcoef(*noise)[0, 1])
same_context = float((first["context"] == second["context"]).all(1).mean())
action = np.array([0])
drawn = {float(np.ravel(data.sample_reward(first["context"][:1], action))[0]) for _ in range(100)}
print(f"obp {version('obp')}: two batches of 1,000 rows")
print(f"  rows with the same context: {same_context:.0%}; correlation of their noise: {correlation:.3f}")
print(f"  different rewards of one action in 100 draws: {len(drawn)}")
assert same_context < 0.01
assert correlation > 0.95, correlation
assert len(drawn) == 1, drawn
PY
