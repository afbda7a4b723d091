#!/usr/bin/env bash
# torchrl 0.14.1: equal action values, with one-hot actions.
#
# Guess: one of the best actions is chosen, and "chosen_action_value" is its value.
# Seen:  the action has a one for each of the best, and the chosen value is their sum. Targets of DQNLoss are
#        so multiplied by the number of equal values: with two actions worth 1 and γ = 0.9 the target is 1.8.
#        It happens with tables or optimistic initial values. With Categorical actions it is right. No
#        warning. (QValueModule in modules/tensordict_module/actors.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Categorical, OneHot
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

print(f"torchrl {version('torchrl')}: actions that are all worth 1, reward 0, gamma 0.9")
found = {}
for number in (2, 4):
    for spec, action in ((Categorical(number), torch.tensor([0])), (OneHot(number), torch.eye(number)[:1])):
        linear = torch.nn.Linear(1, number)
        torch.nn.init.zeros_(linear.weight)
        torch.nn.init.ones_(linear.bias)
        actor = QValueActor(linear, in_keys=["observation"], spec=spec)
        loss = DQNLoss(actor, loss_function="l2", action_space=spec)
        loss.make_value_estimator(gamma=0.9)
        zero = torch.zeros(1, 1)
        after = {"observation": zero, "reward": zero, "done": zero.bool(), "terminated": zero.bool()}
        data = TensorDict({"observation": zero, "action": action, "next": after}, [1])
        value = loss(data)["loss"].item()
        row = actor(TensorDict({"observation": zero}, [1]))
        name = type(spec).__name__
        found[name, number] = (row["action"].sum().item(), row["chosen_action_value"].item(), value)
        print(f"  {number} actions, {name}: {row['action'].tolist()}, chosen value {found[name, number][1]}, loss {value:.2f}")
for number in (2, 4):
    assert abs(found["Categorical", number][2] - 0.01) < 1e-4, found  # the target is 0.9
    assert found["OneHot", number][:2] == (number, float(number)), found
    assert abs(found["OneHot", number][2] - (1 - 0.9 * number) ** 2) < 1e-4, found
PY
