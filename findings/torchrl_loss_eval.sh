#!/usr/bin/env bash
# torchrl 0.14.1: loss.eval() on a loss whose network has dropout.
#
# Guess: as in any PyTorch module, the networks inside are in evaluation mode: two calls on the same batch
#        give the same validation loss.
# Seen:  the network stays in training mode, since a loss keeps its networks outside its modules and has
#        only their parameters. Dropout stays on, so two calls differ, and normalisations would go on
#        learning from validation data. network.eval(), on the module that was passed in, works.
#        (convert_to_functional in objectives/common.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import BCLoss

torch.manual_seed(0)
network = nn.Sequential(nn.Linear(3, 64), nn.Dropout(0.5), nn.Linear(64, 2))
loss = BCLoss(TensorDictModule(network, ["observation"], ["action"]), loss_function="l2")
batch = TensorDict({"observation": torch.ones(8, 3), "action": torch.zeros(8, 2)}, [8])
seen = {}
for name, module in (("loss.eval()", loss), ("network.eval()", network)):
    module.eval()
    values = [loss(batch)["loss_bc"].item() for _ in range(2)]
    seen[name] = network.training, values[0] == values[1]
    print(f"torchrl {version('torchrl')}, {name}: network.training {network.training}, losses {values}")
assert seen == {"loss.eval()": (True, False), "network.eval()": (False, True)}, seen
PY
