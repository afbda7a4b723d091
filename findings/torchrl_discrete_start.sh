#!/usr/bin/env bash
# torchrl 0.14.1: a Gymnasium environment with actions -1, 0 and 1, Discrete(3, start=-1).
#
# Guess: the environment gets -1, 0 or 1.
# Seen:  it gets 0, 1 or 2: start is not read. The first action is never played, and one that is not in the
#        space is. The check of a Gymnasium space would find it, but few environments check. No warning.
#        (envs/libs/gym.py)
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

seen = set()


class Seen(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(3, start=-1)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        seen.add(int(action))
        return np.zeros(1, np.float32), 0.0, False, False, {}


for categorical in (False, True):
    seen.clear()
    torch.manual_seed(0)
    GymWrapper(Seen(), categorical_action_encoding=categorical).rollout(200)
    kind = "categorical" if categorical else "one-hot"
    print(f"torchrl {version('torchrl')}: actions of Discrete(3, start=-1), {kind}: {sorted(seen)}")
    assert seen == {0, 1, 2}, seen
PY
