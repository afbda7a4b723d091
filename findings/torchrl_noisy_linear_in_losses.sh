#!/usr/bin/env bash
# torchrl 0.14.1: NoisyLinear in a network that a loss trains.
#
# Guess: as the page says, "the parameters of the noise are learned with gradient descent".
# Seen:  they get no gradient from any loss. Losses run their networks in the deterministic mode, in which
#        NoisyLinear leaves its noise out. The deviation of the noise keeps its first value for ever, and the
#        agent explores as much at the end as at the start. NoisyLinear(use_exploration_type=False) learns it.
#        No warning. (_should_use_noise in modules/models/exploration.py)
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
from torchrl.data import OneHot
from torchrl.modules import NoisyLinear, QValueActor
from torchrl.objectives import DQNLoss

torch.manual_seed(0)
spec, no = OneHot(3), torch.zeros(256, 1, dtype=torch.bool)
observation = torch.randn(256, 4)
after = {"observation": observation, "reward": torch.ones(256, 1)}
after |= {"done": no, "terminated": torch.ones_like(no)}  # each episode has one step, whose reward is 1
data = TensorDict({"observation": observation, "action": spec.rand((256,)), "next": after}, [256])

print(f"torchrl {version('torchrl')}: mean deviation of the noise before and after 500 updates, no noise needed")
found = {}
for by_mode in (True, False):
    net = nn.Sequential(NoisyLinear(4, 3, use_exploration_type=by_mode))
    loss = DQNLoss(QValueActor(net, in_keys=["observation"], spec=spec), action_space=spec)
    sigma = [p for name, p in loss.named_parameters() if "sigma" in name and "target" not in name]
    assert len(sigma) == 2, sigma
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    before = torch.cat([each.detach().flatten().clone() for each in sigma])
    for _ in range(500):
        for module in net.modules():
            if isinstance(module, NoisyLinear):
                module.reset_noise()
        optimizer.zero_grad()
        loss(data)["loss"].backward()
        optimizer.step()
    after = torch.cat([each.detach().flatten() for each in sigma])
    found[by_mode] = before, after
    print(f"  use_exploration_type={by_mode}: {before.abs().mean():.4f}, {after.abs().mean():.4f}")
assert torch.equal(*found[True]), found
assert found[False][1].abs().mean() < 0.5 * found[False][0].abs().mean(), found
PY
