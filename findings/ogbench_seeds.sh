#!/usr/bin/env bash
# ogbench 1.2.2: the seed of reset(), and the starts of parallel environments.
#
# Guess: reset(seed=3) twice gives the same start and goal, and parallel environments with seeds 0 to 3
#        have four different ones, as Gymnasium says.
# Seen:  starts and goals are drawn from NumPy's global generator. The seed of reset() is not used for
#        them: equal seeds give other starts. Worker processes that are forked have copies of the
#        global generator and all draw the same: four parallel environments play four times the
#        same episode, and the next one, too. A success rate of 20 episodes is one of 5. No warning.
#        np.random.seed() in each process is what counts.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ogbench==1.2.2 dm_control==1.0.41 mujoco==3.8.1 \
  gymnasium==1.4.0 numpy==2.4.0 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import ogbench
from gymnasium.vector import AsyncVectorEnv

TASK = {"task_id": 1}


def make():
    return gym.make("pointmaze-medium-v0")


def show(rows):
    return [np.round(row[:2], 2).tolist() for row in rows]


env = make()
np.random.seed(0)
seeded = [env.reset(seed=3, options=TASK)[0].copy() for _ in range(2)]
print(f"ogbench {version('ogbench')}: starts of reset(seed=3), twice {show(seeded)}")
np.random.seed(1)
first = env.reset(seed=3, options=TASK)[0].copy()
np.random.seed(1)
second = env.reset(seed=4, options=TASK)[0].copy()
print(f"  np.random.seed(1), then reset(seed=3) and reset(seed=4) {show([first, second])}")
assert not np.allclose(*seeded), "the seed is used now"
assert np.allclose(first, second)

envs = AsyncVectorEnv([make] * 4, context="fork")  # Linux's default before Python 3.14
starts = [envs.reset(seed=[0, 1, 2, 3], options=TASK)[0], envs.reset(options=TASK)[0]]
envs.close()
for text, rows in zip(("first", "second"), starts):
    print(f"four processes with seeds 0 to 3, {text} starts {show(rows)}")
assert all(np.allclose(rows, rows[0]) for rows in starts), "processes have starts of their own now"
assert not np.allclose(*starts)
PY
