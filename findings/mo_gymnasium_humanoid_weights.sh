#!/usr/bin/env bash
# mo-gymnasium 1.3.2: mo-humanoid-v5 with the weights that its page gives for Humanoid-v5, [1.25,
# 0.1].
#
# Guess: the weighted sum is the reward of Humanoid-v5.
# Seen:  it is 1.75 larger in every step in which the robot stands: the reward for standing, 5, is in both
#        entries and thus counts 1.35 times. The cost of contacts is, too. (envs/mujoco/humanoid_v5.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mo-gymnasium==1.3.2 gymnasium==1.4.0 numpy==2.4.6 mujoco==3.8.1 imageio==2.37.0 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import mo_gymnasium
import numpy as np

both = []
for env in (gymnasium.make("Humanoid-v5"), mo_gymnasium.make("mo-humanoid-v5")):
    env.reset(seed=0)
    both.append(env.step(np.zeros(env.action_space.shape, np.float32))[1])
scalar, vector = both
weighted = float(np.dot(vector, [1.25, 0.1]))
print(f"mo-gymnasium {version('mo-gymnasium')}, one step: Humanoid-v5 {scalar:.3f}, weighted {weighted:.3f}")
assert abs(weighted - scalar - 1.75) < 0.05, (scalar, weighted)
PY
