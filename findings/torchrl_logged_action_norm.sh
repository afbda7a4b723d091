#!/usr/bin/env bash
# torchrl 0.14.1: the "action_norm" that trainers log (LogScalar of actions).
#
# Guess: as the name and the docstring say, a norm: 5 for the actions (3, 4) and (-3, -4).
# Seen:  it is the mean of the signed components, 0 here. A policy that saturates at both bounds is logged as
#        one that stands still. (LogScalar in trainers/trainers.py; hooks of the trainers in
#        trainers/algorithms)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.trainers import LogScalar

found = {}
print(f"torchrl {version('torchrl')}: logged norm of actions")
for actions in ([[3.0, 4.0], [-3.0, -4.0]], [[3.0, 4.0], [3.0, 4.0]]):
    data = TensorDict({"action": torch.tensor(actions)}, [2])
    found[str(actions)] = float(LogScalar("action", "action_norm")(data)["action_norm"])
    print(f"  {actions}: {found[str(actions)]}; mean norm {data['action'].norm(dim=-1).mean().item()}")
assert list(found.values()) == [0.0, 3.5], found
PY
