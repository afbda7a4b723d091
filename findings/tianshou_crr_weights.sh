#!/usr/bin/env bash
# tianshou 2.0.1: which actions its DiscreteCRR imitates.
#
# Guess: as published (Wang et al. 2020), each action is weighted by its own advantage. In the mode "binary",
#        actions that are better than the policy are imitated and the others are not.
# Seen:  weights have the shape [B, 1] and log-probabilities [B]. Their product is a B x B table, whose mean
#        is the mean log-probability times the mean weight: all actions of the data are imitated alike. Of
#        two actions that the data choose equally often, with values 1 and 0, which the critic knows, the
#        policy keeps choosing each in half of the cases. With the same weights, each row its own, it chooses
#        the better one. No warning. (_update_with_batch in algorithm/imitation/discrete_crr.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet tianshou==2.0.1 torch==2.13.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from tianshou.algorithm import DiscreteCRR
from tianshou.algorithm.modelfree.reinforce import DiscreteActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, ReplayBuffer
from tianshou.utils.torch_utils import policy_within_training_step
from torch import nn


class Table(nn.Module):
    def __init__(self):
        super().__init__()
        self.out = nn.Linear(1, 2)

    def values(self, obs):
        return self.out(torch.as_tensor(np.asarray(obs), dtype=torch.float))


class Actor(Table):
    def forward(self, obs, state=None, info=None):
        return self.values(obs), state


class Critic(Table):
    def forward(self, obs, state=None, info=None):
        return self.values(obs)


torch.manual_seed(0)
np.random.seed(0)
one = np.ones(1, np.float32)
buffer = ReplayBuffer(size=200)
for row in range(200):
    action = row % 2
    ends = {"terminated": True, "truncated": False}
    buffer.add(Batch(obs=one, act=action, rew=float(action), obs_next=one, info={}, **ends))

space = gymnasium.spaces.Discrete(2)
actor, critic = Actor(), Critic()
algorithm = DiscreteCRR(
    policy=DiscreteActorPolicy(actor=actor, action_space=space),
    critic=critic,
    optim=AdamOptimizerFactory(lr=1e-2),
    policy_improvement_mode="binary",
    min_q_weight=0.0,
)
with policy_within_training_step(algorithm.policy):
    for _ in range(2000):
        algorithm.update(buffer=buffer, sample_size=100)

# The same weights, each with its own row.
own = Actor()
optimizer = torch.optim.Adam(own.parameters(), lr=1e-2)
actions = torch.arange(200) % 2
for _ in range(2000):
    log_probability = own(np.ones((200, 1)))[0].log_softmax(-1)
    values = critic(np.ones((200, 1))).detach()
    advantage = values - (log_probability.detach().exp() * values).sum(-1, keepdim=True)
    weight = (advantage.gather(1, actions[:, None]) > 0).float().squeeze(1)
    loss = -(log_probability.gather(1, actions[:, None]).squeeze(1) * weight).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

values = critic(np.ones((1, 1)))[0].tolist()
chosen = actor(np.ones((1, 1)))[0][0].softmax(-1).tolist()
right = own(np.ones((1, 1)))[0][0].softmax(-1).tolist()
print(f"tianshou {version('tianshou')}, DiscreteCRR, binary: two actions with rewards 0 and 1")
print(f"  values {values[0]:.2f}, {values[1]:.2f}; probability of the better action {chosen[1]:.2f}")
print(f"  with each row's own weight: {right[1]:.2f}")
assert values[1] - values[0] > 0.8, values
assert abs(chosen[1] - 0.5) < 0.1, chosen
assert right[1] > 0.95, right
PY
