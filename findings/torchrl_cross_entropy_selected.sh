#!/usr/bin/env bash
# torchrl 0.14.1: torchrl.objectives.functional.cross_entropy_loss with inplace=True.
#
# Guess: as its page says, it "fills log_policy in-place with 0.0 at non-selected actions", is faster and
#        gives the same number: the log-probability of the selected action.
# Seen:  it fills the selected action instead and gives the sum of the others. For p = (.5, .3, .2) and action
#        0 that is -2.81 instead of -0.69: an update makes the other actions likely. No warning.
#        (objectives/functional.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.objectives.functional import cross_entropy_loss

log_probabilities = torch.tensor([[0.5, 0.3, 0.2]]).log()
action = torch.tensor([[True, False, False]])
plain = cross_entropy_loss(log_probabilities.clone(), action).item()
inplace = cross_entropy_loss(log_probabilities.clone(), action, inplace=True).item()
print(f"torchrl {version('torchrl')}: p = (0.5, 0.3, 0.2), action 0: {plain:.4f}, inplace {inplace:.4f}")
assert abs(plain + 0.6931) < 1e-3 and abs(inplace + 2.8134) < 1e-3
PY
