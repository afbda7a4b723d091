#!/usr/bin/env bash
# torchrl 0.14.1: fast_encoding() of a Gym environment whose rewards are Python integers.
#
# Guess: it is faster and gives the same rewards.
# Seen:  if the first reward is the integer 0, every reward of the environment is 0 from then on: the way in
#        which a reward is read is chosen at the first one and kept. If the first is 1, rewards are right. The
#        page says that it skips checks. (read_reward in envs/gym_like.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
import gymnasium
import numpy as np
from torchrl.envs import GymWrapper


class Rewarded(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, rewards):
        self.rewards = rewards

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        return np.zeros(1, np.float32), self.rewards[self.time - 1], self.time == len(self.rewards), False, {}


def rewards_of(rewards, fast):
    environment = GymWrapper(Rewarded(rewards))
    if fast:
        environment.fast_encoding()
    return environment.rollout(10)["next", "reward"].flatten().tolist()


print(f"torchrl {version('torchrl')}: rewards without and with fast_encoding")
found = {}
for rewards in ([0, 0, 1], [1, 0, 1], [0.0, 0.0, 1.0]):
    found[str(rewards)] = [rewards_of(rewards, fast) for fast in (False, True)]
    print(f"  {rewards}: {found[str(rewards)][0]}, {found[str(rewards)][1]}")
assert found["[0, 0, 1]"] == [[0, 0, 1], [0, 0, 0]], found
assert found["[1, 0, 1]"][1] == [1, 0, 1], found
PY
