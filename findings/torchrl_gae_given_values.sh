#!/usr/bin/env bash
# torchrl 0.14.1: GAE with a value network and data that already contain "state_value".
#
# Guess: as the page says, if the value is "already present in the input tensordict, the GAE module will
#        ignore the calls to the value network (if any) and use the provided value instead".
# Seen:  the provided values are replaced by the network's, in the data as well. Values of another network, or
#        of the time when the data were collected, are lost, and nothing says so. Without a network the
#        provided values are used. (GAE.forward in objectives/value/advantages.py)
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
from torchrl.objectives.value import GAE


class Hundred(nn.Module):
    def forward(self, observation):
        return torch.full_like(observation, 100.0)


def data():
    end = torch.zeros(1, 3, 1, dtype=torch.bool)
    end[0, -1] = True
    after = {"observation": torch.zeros(1, 3, 1), "reward": torch.zeros(1, 3, 1)}
    after |= {"done": end, "terminated": end.clone(), "state_value": torch.full((1, 3, 1), 5.0)}
    values = {"observation": torch.zeros(1, 3, 1), "state_value": torch.full((1, 3, 1), 5.0)}
    return TensorDict(values | {"next": after}, [1, 3])


print(f"torchrl {version('torchrl')}: the data have the value 5, the network gives 100; rewards 0")
found = {}
for name, network in (("without a network", None), ("with it", ValueOperator(Hundred(), in_keys=["observation"]))):
    result = GAE(gamma=1.0, lmbda=0.0, value_network=network)(data())
    found[name] = (result["state_value"][0, 0].item(), result["advantage"][0, -1].item())
    print(f"  {name}: state_value {found[name][0]:.0f}, advantage of the last step {found[name][1]:.0f}")
assert found["without a network"] == (5.0, -5.0), found
assert found["with it"] == (100.0, -100.0), found
PY
