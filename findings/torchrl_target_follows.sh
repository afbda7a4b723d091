#!/usr/bin/env bash
# torchrl 0.14.1: what SoftUpdate copies to a target network.
#
# Guess: after many updates without training in between, the target network is the critic.
# Seen:  the updater chooses its tensors when it is made, and takes those that have requires_grad
#        then. A layer that is frozen at first and trained later never reaches the target, which goes
#        on with the layer's first weights. Buffers, such as the statistics of a normalisation that
#        are set later, never reach it, either. No warning. A new updater copies all of it once, and
#        follows the layer.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate


class Critic(nn.Module):
    """A layer that is frozen at first, a head, and a mean that is set later."""

    def __init__(self):
        super().__init__()
        self.first, self.head = nn.Linear(5, 8), nn.Linear(8, 1)
        self.register_buffer("mean", torch.zeros(5))

    def forward(self, observation, action):
        inputs = torch.cat([observation, action], -1) - self.mean
        return self.head(torch.relu(self.first(inputs)))


torch.manual_seed(0)
actor = TensorDictModule(nn.Linear(3, 2), ["observation"], ["action"])
critic = ValueOperator(Critic(), in_keys=["observation", "action"])
critic.module.first.requires_grad_(False)
loss = DDPGLoss(actor, critic)
updater = SoftUpdate(loss, tau=0.5)
online, target = loss.value_network_params["module"], loss.target_value_network_params["module"]

for name in ("weight", "bias"):
    online["first", name].requires_grad_(True)
online["mean"].data.fill_(3.0)
flag = torch.zeros(16, 1, dtype=torch.bool)
data = {"observation": torch.randn(16, 3), "action": torch.randn(16, 2)}
after = {"observation": torch.randn(16, 3), "reward": torch.ones(16, 1), "done": flag}
data = TensorDict({**data, "next": {**after, "terminated": flag.clone()}}, [16])
optimizer = torch.optim.Adam(loss.value_network_params.flatten_keys().values(), lr=0.1)
before = online["first", "weight"].detach().clone()
for _ in range(20):
    optimizer.zero_grad()
    loss(data)["loss_value"].backward()
    optimizer.step()
moved = (online["first", "weight"] - before).abs().max().item()


def distance(key):
    return (online[key] - target[key]).abs().max().item()


def report(updater, text):
    for _ in range(100):
        updater.step()
    gaps = [distance(key) for key in (("head", "weight"), ("first", "weight"), "mean")]
    print(f"torchrl {version('torchrl')}, {text}: critic and target differ by {gaps[0]:.3f} in the head,")
    print(f"  {gaps[1]:.3f} in the layer that moved by {moved:.3f}, {gaps[2]:.3f} in the mean")
    return gaps


head, layer, mean = report(updater, "100 updates with tau 0.5")
assert moved > 0.1 and head < 1e-5, "the part that was never frozen has not been copied"
assert abs(layer - moved) < 1e-5, "the target now follows a layer that was frozen"
assert mean == 3.0, "the target now follows buffers"
online["head", "weight"].data.add_(1.0), online["first", "weight"].data.add_(1.0)
online["mean"].data.fill_(5.0)
head, layer, mean = report(SoftUpdate(loss, tau=0.5), "with a new updater")
assert max(head, layer) < 1e-5 and mean == 0.0, "a new updater does otherwise"
PY
