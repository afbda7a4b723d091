#!/usr/bin/env bash
# torchrl 0.14.1: the λ-return of DreamerActorLoss, which the actor is trained on.
#
# Guess: as the page says, the "lambda return": a reward at the end of an imagined trajectory of 15 steps
#        reaches its first step with (γ λ)^14 of its weight.
# Seen:  each step has its one-step return, r + γ V, whatever λ is. A reward at the end reaches the last step
#        only. The estimator takes the trailing dimension of one number for time, so that each step counts as
#        the end of a trajectory. Returns for λ = 0.5 and λ = 1 are equal. No warning. (lambda_target in
#        objectives/dreamer.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from torch import nn
from torchrl.objectives import DreamerActorLoss

GAMMA = 0.99
reward, value = torch.zeros(1, 15, 1), torch.full((1, 15, 1), 2.0)
reward[0, -1] = 1.0

print(f"torchrl {version('torchrl')}: returns of the first and the last step, values 2, reward 1 at the end")
found = {}
for lmbda in (0.5, 0.95, 1.0):
    loss = DreamerActorLoss(nn.Identity(), nn.Identity(), nn.Identity())
    loss.make_value_estimator(gamma=GAMMA, lmbda=lmbda)
    target, expected = value[0, -1, 0].item(), []
    for r, v in zip(reward.flatten().flip(0).tolist(), value.flatten().flip(0).tolist(), strict=True):
        target = r + GAMMA * ((1 - lmbda) * v + lmbda * target)
        expected.insert(0, target)
    got = loss.lambda_target(reward, value).flatten()
    found[lmbda] = got
    print(f"  lambda {lmbda}: {got[0]:.3f}, {got[-1]:.3f}; by definition {expected[0]:.3f}, {expected[-1]:.3f}")
    assert torch.allclose(got, reward.flatten() + GAMMA * value.flatten()), got
assert all(torch.equal(each, found[0.5]) for each in found.values())
assert abs(expected[0] - found[1.0][0]) > 0.5, expected
PY
