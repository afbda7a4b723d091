#!/usr/bin/env bash
# torchrl 0.14.1: SoftUpdate that is made after a checkpoint was loaded into the loss.
#
# Guess: training goes on where it stopped. The updater only moves the targets that are there.
# Seen:  making SoftUpdate or HardUpdate copies the critic over the target networks. The targets of the
#        checkpoint are lost without a warning; the same two lines in the other order keep them.
#        (TargetNetUpdater in objectives/utils.py)
#
# Here: docs/trainer.md makes the updater before it loads.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate


class Critic(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3, 1)

    def forward(self, observation, action):
        return self.layer(torch.cat([observation, action], -1))


def make_loss():
    actor = TensorDictModule(nn.Linear(2, 1), ["observation"], ["action"])
    return DDPGLoss(actor, ValueOperator(Critic(), in_keys=["observation", "action"]), delay_value=True)


torch.manual_seed(0)
saved = make_loss()
SoftUpdate(saved, tau=0.005)
for value in saved.target_value_network_params.values(True, True):
    value.data.fill_(7.0)
weight = ("module", "layer", "weight")
seen = {}
for order in ("load, then SoftUpdate", "SoftUpdate, then load"):
    loss = make_loss()
    if order.startswith("Soft"):
        updater = SoftUpdate(loss, tau=0.005)
    loss.load_state_dict(saved.state_dict())
    if order.startswith("load"):
        updater = SoftUpdate(loss, tau=0.005)
    target = loss.target_value_network_params[weight]
    seen[order] = bool((target == 7).all()), torch.equal(target, loss.value_network_params[weight].data)
    print(f"torchrl {version('torchrl')}, {order}: targets are the saved ones {seen[order][0]},")
    print(f"  equal to the critic {seen[order][1]}")
assert seen == {"load, then SoftUpdate": (False, True), "SoftUpdate, then load": (True, False)}, seen
PY
