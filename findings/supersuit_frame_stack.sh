#!/usr/bin/env bash
# supersuit 3.11.0: frame_stack_v1 with stack_dim=0 and grayscale frames.
#
# Guess: the last four frames, along the first axis. With stack_dim=-1, the default, along the last one.
# Seen:  along the first axis there are three copies of the newest frame and one frame of zeros: the agent
#        sees no history. The last axis is right. Also, every step returns the same array, changed in place:
#        an observation that is kept for a replay buffer equals its next observation. No warning. (stack_obs
#        in utils/frame_stack.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet supersuit==3.11.0 pettingzoo==1.27.0 gymnasium==1.4.0 numpy==2.2.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import supersuit


class Frames(gym.Env):
    """Every pixel is the number of the frame."""

    observation_space = gym.spaces.Box(0, 255, (2, 2), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def look(self):
        return np.full((2, 2), self.time, np.uint8)

    def reset(self, *, seed=None, options=None):
        self.time = 1
        return self.look(), {}

    def step(self, action):
        self.time += 1
        return self.look(), 0.0, False, False, {}


print(f"supersuit {version('supersuit')}: one pixel of the last four frames, of which the newest is 6")
found = {}
for axis in (-1, 0):
    environment = supersuit.frame_stack_v1(Frames(), 4, stack_dim=axis)
    environment.reset()
    for _ in range(5):
        stack = environment.step(0)[0]
    found[axis] = (stack[0, 0] if axis else stack[:, 0, 0]).tolist()
    print(f"  stack_dim={axis}: {found[axis]}")
environment = supersuit.frame_stack_v1(Frames(), 4)
first, _ = environment.reset()
kept = first.copy()
following = environment.step(0)[0]
same, changed = first is following, not np.array_equal(first, kept)
print(f"  the observation of a reset is that of the next step: {same}; it has changed: {changed}")
assert found == {-1: [3, 4, 5, 6], 0: [6, 6, 6, 0]}, found
assert same and changed
PY
