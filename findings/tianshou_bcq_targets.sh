#!/usr/bin/env bash
# tianshou 2.0.1: the target of its BCQ.
#
# Guess: the target is that of the paper (Fujimoto et al. 2019, algorithm 1): next actions of the
#        generator, perturbed by the target of the perturbation network; and, as in tianshou's TD3, it
#        bootstraps at a time limit, for which rows have terminated and truncated apart.
# Seen:  the next actions are not perturbed. The target of the perturbation network is made, and moves
#        after each update, but nothing calls it. And the target is the reward alone in rows where done
#        is set, so that a time limit counts as a termination. No warning.
#
# Here: BCQLoss perturbs candidates by the target network, and bootstraps at time limits.
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
from tianshou.algorithm import BCQ
from tianshou.algorithm.imitation.bcq import BCQPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, ReplayBuffer
from tianshou.utils.net.continuous import VAE
from torch import nn


class Critic(nn.Module):
    """Its value is 10 everywhere."""

    def __init__(self):
        super().__init__()
        self.value = nn.Linear(3, 1)
        nn.init.zeros_(self.value.weight)
        nn.init.constant_(self.value.bias, 10.0)

    def forward(self, observation, action):
        return self.value(torch.cat([observation, action], -1))


class Perturbation(nn.Module):
    calls = 0

    def __init__(self):
        super().__init__()
        self.shift = nn.Linear(3, 1)

    def forward(self, observation, action):
        self.calls += 1
        return action + 0.05 * torch.tanh(self.shift(torch.cat([observation, action], -1)))


torch.manual_seed(0)
vae = VAE(
    encoder=nn.Sequential(nn.Linear(3, 8), nn.ReLU()),
    decoder=nn.Linear(3, 1),
    hidden_dim=8,
    latent_dim=1,
    max_action=1.0,
)
space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
policy = BCQPolicy(
    actor_perturbation=Perturbation(), critic=Critic(), vae=vae, action_space=space
)
rate = AdamOptimizerFactory(lr=0.0)
algorithm = BCQ(
    policy=policy, actor_perturbation_optim=rate, critic_optim=rate, vae_optim=rate, gamma=0.5
)

buffer = ReplayBuffer(2)
for name in ("terminated", "truncated"):
    ends = {"terminated": name == "terminated", "truncated": name == "truncated"}
    obs, act, after = (np.full(n, x, np.float32) for n, x in ((2, 0), (1, 0), (2, 1)))
    row = {"obs": obs, "act": act, "rew": 1.0, "obs_next": after}
    buffer.add(Batch(**row, **ends))

print(f"tianshou {version('tianshou')}, BCQ: reward 1, next value 10, gamma 0.5")
targets = {}
for i, name in enumerate(("terminated", "truncated")):
    stats = algorithm._update_with_batch(buffer[np.array([i])])
    targets[name] = 10.0 - stats.critic1_loss**0.5  # the squared error of a value of 10
    print(f"  a row that is {name}: target {targets[name]:.4f}")
assert abs(targets["terminated"] - 1.0) < 1e-4
assert abs(targets["truncated"] - 1.0) < 1e-4, "a time limit is told from a termination now"

calls = algorithm.actor_perturbation_target.module.calls
print(f"  calls of the perturbation's target network: {calls} in two updates")
assert calls == 0, "the target of the perturbation is used now"
assert policy.actor_perturbation.calls == 2  # for the perturbation's own loss
PY
