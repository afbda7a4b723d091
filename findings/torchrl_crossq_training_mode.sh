#!/usr/bin/env bash
# torchrl 0.14.1: CrossQLoss on validation data, with the critics in evaluation mode.
#
# Guess: the critics' normalisation uses its running statistics and leaves them as they are, in all calls.
# Seen:  the loss sets the critics to training mode after every actor loss. From the second call on,
#        validation batches are normalised by themselves and move the running statistics of training.
#        (actor_loss in objectives/crossq.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import CrossQLoss


class Critic(nn.Module):
    def __init__(self):
        super().__init__()
        self.norm, self.layer = nn.BatchNorm1d(5), nn.Linear(5, 1)

    def forward(self, observation, action):
        return self.layer(self.norm(torch.cat([observation, action], -1)))


torch.manual_seed(0)
flags = {name: torch.zeros(8, 1, dtype=torch.bool) for name in ("done", "terminated")}
following = TensorDict({"observation": torch.randn(8, 3), "reward": torch.randn(8, 1), **flags}, [8])
batch = TensorDict({"observation": torch.randn(8, 3), "action": torch.rand(8, 2) - 0.5, "next": following}, [8])
network = TensorDictModule(nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()), ["observation"], ["loc", "scale"])
actor = ProbabilisticActor(network, in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal, return_log_prob=True)
critics = [ValueOperator(Critic(), in_keys=["observation", "action"]) for _ in range(2)]
loss = CrossQLoss(actor, critics, num_qvalue_nets=2, target_entropy=-2.0)
for critic in critics:
    critic.eval()
norm = critics[0].module.norm
before = loss.qvalue_network_params["module", "norm", "running_mean"].clone()
seen = []
for call in range(2):
    loss.qvalue_loss(batch)
    moved = not torch.equal(before, loss.qvalue_network_params["module", "norm", "running_mean"])
    seen.append((norm.training, moved))
    print(f"torchrl {version('torchrl')}, call {call + 1}: training mode {norm.training}, running mean moved {moved}")
    loss.actor_loss(batch)
assert seen == [(False, False), (True, True)], seen
PY
