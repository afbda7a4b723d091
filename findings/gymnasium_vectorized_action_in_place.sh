#!/usr/bin/env bash
# gymnasium 1.4.0: VectorizeTransformAction, which applies an action wrapper to each of several environments.
#
# Guess: as with TransformAction on one environment, the array that the caller passes stays as it is.
# Seen:  if the wrapper keeps the action space, it is overwritten with the transformed actions: what one logs
#        or stores after step() is not what the policy chose. A constant array that is passed again is
#        transformed again: with a change of sign, every other step goes the wrong way. No warning. Wrappers
#        that change the space are safe. (VectorizeTransformAction.actions in
#        wrappers/vector/vectorize_action.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.2.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformAction
from gymnasium.wrappers.vector import VectorizeTransformAction


class Echo(gym.Env):
    """Observes its last action."""

    observation_space = action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.array(action), 0.0, False, False, {}


def negate(action):
    return -action


single = TransformAction(Echo(), negate, Echo.action_space)
single.reset()
alone = np.full(1, 0.5, np.float32)
alone_seen = [single.step(alone)[0].item() for _ in range(2)]
vector = gym.vector.SyncVectorEnv([Echo, Echo])
vector = VectorizeTransformAction(
    vector, wrapper=TransformAction, func=negate, action_space=vector.single_action_space
)
vector.reset()
actions = np.full((2, 1), 0.5, np.float32)
seen = []
for _ in range(2):
    seen.append(vector.step(actions)[0][0].item())
    print(f"gymnasium {version('gymnasium')}: the environments get {seen[-1]}, the caller's array is now {actions[0].item()}")
print(f"  one environment gets {alone_seen}, the caller's array stays {alone.item()}")
assert alone_seen == [-0.5, -0.5] and alone.item() == 0.5
assert seen == [-0.5, 0.5], seen
PY
