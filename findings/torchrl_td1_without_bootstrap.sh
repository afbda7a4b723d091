#!/usr/bin/env bash
# torchrl 0.14.1: td1_return_estimate(rolling_gamma=False) for a trajectory that goes on.
#
# Guess: for one constant γ, rolling_gamma changes nothing: the return of the last row is r + γ V(next).
# Seen:  with rolling_gamma=False the value after the last row is left out. With rewards 0, values 10 and γ =
#        0.9, returns are 0 and 0 instead of 8.1 and 9. Trajectories that end are right. No warning.
#        (objectives/value/functional.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.objectives.value.functional import td1_return_estimate

gamma, reward = torch.full((1, 2, 1), 0.9), torch.zeros(1, 2, 1)
values, goes_on = torch.full((1, 2, 1), 10.0), torch.zeros(1, 2, 1, dtype=torch.bool)
ends = goes_on.clone()
ends[0, -1] = True
print(f"torchrl {version('torchrl')}: returns of two rows, rewards 0, next values 10, gamma 0.9")
found = {}
for name, done in (("goes on", goes_on), ("ends", ends)):
    for rolling in (True, False):
        result = td1_return_estimate(gamma, values, reward, done, rolling_gamma=rolling)
        found[name, rolling] = result.flatten().tolist()
        print(f"  {name}, rolling_gamma={rolling}: {[round(each, 3) for each in found[name, rolling]]}")
assert torch.allclose(torch.tensor(found["goes on", True]), torch.tensor([8.1, 9.0])), found
assert found["goes on", False] == [0.0, 0.0], found
assert found["ends", True] == found["ends", False] == [0.0, 0.0], found
PY
