#!/usr/bin/env bash
# tianshou 2.0.1: the random actions of its CQL.
#
# Guess: num_repeat_actions actions of each state are uniform between min_action and max_action, and
#        one log-sum-exp runs over them and the policy's.
# Seen:  they are uniform between -min_action and max_action. With the defaults, -1 and 1, all of them
#        are 1 in every entry: one corner of the space is pushed down and the rest is not. And the
#        log-sum-exp runs over one random action and two of the policy at a time, not over all 30:
#        the result of a reshape is not kept. No warning.
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
from tianshou.algorithm import CQL
from tianshou.algorithm.modelfree.sac import SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, ReplayBuffer
from torch import nn

ROWS, REPEATS = 4, 10


class Actor(nn.Module):
    def __init__(self):
        super().__init__()
        self.mean = nn.Linear(2, 2)

    def forward(self, observation, state=None, info=None):
        mean = self.mean(torch.as_tensor(observation, dtype=torch.float))
        return (mean, torch.ones_like(mean)), state


class Critic(nn.Module):
    seen = []

    def __init__(self):
        super().__init__()
        self.value = nn.Linear(4, 1)

    def forward(self, observation, action):
        Critic.seen.append(action.detach())
        return self.value(torch.cat([observation, action], -1))


torch.manual_seed(0)
space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
rate = AdamOptimizerFactory(lr=0.0)
algorithm = CQL(
    policy=SACPolicy(actor=Actor(), action_space=space),
    policy_optim=rate,
    critic=Critic(),
    critic_optim=rate,
    num_repeat_actions=REPEATS,
    with_lagrange=False,
    calibrated=False,
)
assert (algorithm.min_action, algorithm.max_action) == (-1.0, 1.0)  # the defaults
buffer = ReplayBuffer(ROWS)
for i in range(ROWS):
    obs, act, after = (np.full(2, x, np.float32) for x in (i / ROWS, 0, 1))
    row = {"obs": obs, "act": act, "rew": 0.0, "obs_next": after}
    buffer.add(Batch(**row, terminated=False, truncated=False))

sums, real = [], torch.logsumexp
torch.logsumexp = lambda value, dim: sums.append((tuple(value.shape), dim)) or real(value, dim)
algorithm._update_with_batch(buffer[np.arange(ROWS)])
# The actions of the critics, in order: the last two calls are about the random ones.
drawn = Critic.seen[-1]
print(f"tianshou {version('tianshou')}, CQL with min_action -1 and max_action 1")
print(f"  {len(drawn)} random actions, lowest entry {drawn.min():.1f}, highest {drawn.max():.1f}")
assert drawn.shape == (ROWS * REPEATS, 2)
assert (drawn == 1).all(), "the random actions have changed"
print(f"  log-sum-exp over dimension {sums[0][1]} of {sums[0][0]}")
assert sums[0] == ((ROWS * REPEATS, 3), 1), "the log-sum-exp has changed"
PY
