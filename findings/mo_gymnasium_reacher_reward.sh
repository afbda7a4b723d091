#!/usr/bin/env bash
# mo-gymnasium 1.3.2: the reward of mo-reacher-v5.
#
# Guess: that of the state which the action leads to.
# Seen:  it is computed before the simulator moves, so it is that of the state before the action: in one
#        state all actions have one reward. Each target's distance is also multiplied by another factor
#        than the page says. (envs/mujoco/reacher_v5.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mo-gymnasium==1.3.2 gymnasium==1.4.0 numpy==2.4.6 mujoco==3.8.1 imageio==2.37.0 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import mo_gymnasium
import numpy as np

env = mo_gymnasium.make("mo-reacher-v5")
seen = []
for action in (0, 8):
    env.reset(seed=0)
    observation, reward, *_ = env.step(action)
    seen.append((observation, reward))
(a, first), (b, second) = seen
print(f"mo-gymnasium {version('mo-gymnasium')}: two actions in one state, observations differ by {np.abs(a - b).max():.3f}, rewards by {np.abs(first - second).max():.3f}")
assert np.abs(a - b).max() > 0.01 and np.array_equal(first, second)
PY
