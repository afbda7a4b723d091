#!/usr/bin/env bash
# torchrl 0.14.1: ConvNet(bias_last_layer=False).
#
# Guess: the last layer has no bias, as the argument says and as MLP does it.
# Seen:  it has one, with True, with False and by default: the condition in the source is always true. A
#        network that should map zero to zero does not. The same holds for Conv3dNet. No warning.
#        (modules/models/models.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.modules import MLP, ConvNet

has = {}
for given in (False, True):
    net = ConvNet(in_features=3, num_cells=[4, 5], kernel_sizes=1, bias_last_layer=given)
    layers = [layer for layer in net.modules() if isinstance(layer, torch.nn.Conv2d)]
    mlp = MLP(in_features=3, out_features=5, num_cells=[4], bias_last_layer=given)
    linear = [layer for layer in mlp.modules() if isinstance(layer, torch.nn.Linear)]
    has[given] = (layers[-1].bias is not None, linear[-1].bias is not None)
    print(f"torchrl {version('torchrl')}: bias_last_layer={given}: ConvNet {has[given][0]}, MLP {has[given][1]}")
assert has == {False: (True, False), True: (True, True)}, has
PY
