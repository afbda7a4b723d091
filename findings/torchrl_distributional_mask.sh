#!/usr/bin/env bash
# torchrl 0.14.1: DistributionalQValueModule with a mask of actions.
#
# Guess: an action that the mask forbids is never chosen.
# Seen:  it is chosen whenever the values of all allowed actions are negative, say costs. The mask sets its
#        log-probabilities to the lowest number, so its probabilities are 0 and its value is 0, which is
#        higher than -1.5. With positive values it is never chosen. QValueModule is right in both cases. No
#        warning. (modules/tensordict_module/actors.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.modules import DistributionalQValueModule, QValueModule

mask = torch.tensor([True, False, True])
print(f"torchrl {version('torchrl')}: three actions of equal values, of which the mask forbids number 1")
chosen = {}
for support in ([1.0, 2.0], [-2.0, -1.0]):
    atoms = torch.tensor(support)
    module = DistributionalQValueModule("categorical", support=atoms, action_mask_key="mask")
    log_probabilities = torch.zeros(2, 3).log_softmax(-2)
    data = TensorDict({"action_value": log_probabilities, "mask": mask}, [])
    plain = QValueModule("categorical", action_mask_key="mask")
    values = TensorDict({"action_value": atoms.mean().expand(3).clone(), "mask": mask}, [])
    chosen[atoms.mean().item()] = (module(data)["action"].item(), plain(values)["action"].item())
for value, (distributional, expected) in chosen.items():
    print(f"  values {value}: action {distributional}; QValueModule: {expected}")
assert chosen[1.5][0] != 1 and chosen[-1.5][0] == 1, chosen
assert all(expected != 1 for _, expected in chosen.values()), chosen
PY
