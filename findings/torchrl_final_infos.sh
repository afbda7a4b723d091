#!/usr/bin/env bash
# torchrl 0.14.1: GymWrapper(env).auto_register_info_dict(), an env that reports is_success at the end
# of an episode.
#
# Guess: all the information in the info dictionaries is read, so a rollout to the end has is_success.
# Seen:  the names are taken from the first step once and for all. What only the last step reports is
#        dropped without a warning, as are success flags of many environments.
#        default_info_dict_reader(['is_success']) reads it. (envs/gym_like.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
from torchrl.envs import GymWrapper
from torchrl.envs.gym_like import default_info_dict_reader


class Three(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    time = 0

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return np.zeros(1, np.float32), {"x": np.float32(0)}

    def step(self, action):
        self.time += 1
        last = self.time == 3
        info = {"x": np.float32(0)} | ({"is_success": np.float32(1)} if last else {})
        return np.zeros(1, np.float32), 0.0, last, False, info


found = {}
for name, env in {
    "auto_register_info_dict()": GymWrapper(Three()).auto_register_info_dict(),
    "default_info_dict_reader(['is_success'])": GymWrapper(Three()).set_info_dict_reader(
        default_info_dict_reader(["is_success"])
    ),
}.items():
    rollout = env.rollout(3)["next"]
    found[name] = rollout["is_success"].flatten().tolist() if "is_success" in rollout.keys() else None
    print(f"torchrl {version('torchrl')}, {name}: is_success {found[name]}")
assert list(found.values()) == [None, [0.0, 0.0, 1.0]], found
PY
