#!/usr/bin/env bash
# torchrl 0.14.1: GAE on a value network of which some layers are frozen.
#
# Guess: computing advantages changes nothing in the network: layers that were frozen with
#        requires_grad_(False) stay frozen.
# Seen:  one call makes every parameter trainable again if the first one of the network was. A pretrained,
#        frozen part after a trainable one is then trained by an optimizer over all parameters. If the first
#        parameter is frozen, nothing changes. No warning. (hold_out_net in objectives/utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives.value import GAE, TD0Estimator

end = torch.zeros(1, 3, 1, dtype=torch.bool)
after = {"observation": torch.zeros(1, 3, 2), "reward": torch.zeros(1, 3, 1)}
after |= {"done": end, "terminated": end.clone()}
data = TensorDict({"observation": torch.zeros(1, 3, 2), "next": after}, [1, 3])

print(f"torchrl {version('torchrl')}: requires_grad of three layers before and after")
found = {}
for frozen in (1, 0):
    for name, make in (("GAE", lambda net: GAE(gamma=0.9, lmbda=0.9, value_network=net)),
                       ("TD0Estimator", lambda net: TD0Estimator(gamma=0.9, value_network=net))):
        layers = [nn.Linear(2, 2), nn.Linear(2, 2), nn.Linear(2, 1)]
        layers[frozen].requires_grad_(False)
        network = ValueOperator(nn.Sequential(*layers), in_keys=["observation"])
        before = [layer.weight.requires_grad for layer in layers]
        make(network)(data.clone())
        found[name, frozen] = [layer.weight.requires_grad for layer in layers]
        print(f"  {name}, layer {frozen} frozen: {before}, {found[name, frozen]}")
assert found["GAE", 1] == [True, True, True], found
assert found["GAE", 0] == [False, True, True], found
PY
