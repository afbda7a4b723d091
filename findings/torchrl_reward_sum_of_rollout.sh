#!/usr/bin/env bash
# torchrl 0.14.1: RewardSum on a rollout that is already there.
#
# Guess: outside an environment it asks for a dimension named "time" and sums along it, episode by
#        episode, as it does step by step inside an environment.
# Seen:  it sums along the dimension before that one. A rollout of one environment keeps its single
#        rewards, a rollout of two has the sum of the first environment's rewards and the second's,
#        step by step. Ends of episodes are not looked at. No warning.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from torchrl.envs import PendulumEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import RewardSum

KEYS = {"in_keys": [("next", "reward")], "out_keys": [("next", "sum")]}


def rollout(env):
    torch.manual_seed(0)
    env.set_seed(0)
    data = TransformedEnv(env, RewardSum()).rollout(4)
    assert data.names[-1] == "time"
    seen = RewardSum(**KEYS)(data.clone())["next", "sum"].squeeze(-1)
    reward = data["next", "reward"].squeeze(-1)
    inside = data["next", "episode_reward"].squeeze(-1)
    assert torch.allclose(inside, reward.cumsum(-1)), "wrong inside the environment"
    return reward, inside, seen


def show(values):
    return [[round(value, 2) for value in row] for row in values.reshape(-1, 4).tolist()]


reward, inside, seen = rollout(PendulumEnv())
print(f"torchrl {version('torchrl')}, one environment: rewards {show(reward)}")
print(f"  summed inside the environment {show(inside)}, on the rollout {show(seen)}")
assert not torch.allclose(seen, inside), "the rollout is summed along its time now"
assert torch.equal(seen, reward), "other sums on a rollout of one environment"

reward, inside, seen = rollout(SerialEnv(2, PendulumEnv))
print(f"two environments: rewards {show(reward)}")
print(f"  summed inside the environment {show(inside)}, on the rollout {show(seen)}")
assert torch.allclose(seen, reward.cumsum(0)), "other sums on a rollout of two environments"
PY
