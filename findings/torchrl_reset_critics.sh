#!/usr/bin/env bash
# torchrl 0.14.1: LossModule.reset_parameters_recursive() on a loss with an ensemble of critics.
#
# Guess: the critics are as freshly made ones, and each target equals its critic again.
# Seen:  the weights of a hidden layer of 256 units have a standard deviation of 0.0023, where a
#        fresh layer has 0.036: the critics lie stacked, [2, 256, 256], and the initialisation takes
#        the first dimension for outputs and the others for inputs. The targets are drawn apart from
#        the critics and differ from them. An ensemble of one, [1, 256, 256], is no better.
#
# Here: OfflineLoss initialises each critic on its own and copies it to its target.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP
from torchrl.objectives import TD3Loss

torch.manual_seed(0)
actor = TensorDictModule(MLP(17, 6, num_cells=[256, 256]), ["observation"], ["action"])
critic = TensorDictModule(
    MLP(23, 1, num_cells=[256, 256]), ["observation", "action"], ["state_action_value"]
)
layer = ("module", "2", "weight")
fresh = torch.nn.Linear(256, 256).weight.std().item()
seen = {}
for number in (1, 2):
    loss = TD3Loss(actor, critic, bounds=(-1.0, 1.0), num_qvalue_nets=number)
    loss.reset_parameters_recursive()
    weight = loss.qvalue_network_params[layer]
    target = loss.target_qvalue_network_params[layer]
    seen[number] = weight.std().item() / fresh, torch.equal(weight, target)
    print(f"torchrl {version('torchrl')}, ensemble of {number}, {tuple(weight.shape)}: standard deviation")
    print(f"  {seen[number][0]:.3f} of a fresh layer's; target equal to critic: {seen[number][1]}")
assert all(scale < 0.1 for scale, _ in seen.values()), "the scale of stacked critics has changed"
assert not any(equal for _, equal in seen.values()), "targets now equal their critics"
PY
