#!/usr/bin/env bash
# gymnasium 1.4.0: MaxAndSkipObservation at the end of an episode.
#
# Guess: an action is repeated skip times or until the episode ends, and the observation is the maximum of
#        the last two; the last one of an episode contains its last state.
# Seen:  only repeats skip - 1 and skip are kept. If the episode ends before, the last observation is older
#        than its last state. If it ends within the first skip - 2 repeats of its first step, the observation
#        is one of the episode before: nothing is cleared at a reset. The value after a time limit is then
#        that of another state, and a success that shows in the last state is not seen. No warning.
#        (step and reset in wrappers/stateful_observation.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.4.0

"$folder/venv/bin/python" - <<'PY'
import gymnasium as gym
import numpy as np


class Counter(gym.Env):
    """Its observation is 100 times the number of the episode, plus the time."""

    observation_space = gym.spaces.Box(0, 1000, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, lengths):
        self.lengths, self.episode = lengths, 0

    def observe(self):
        return np.array([100 * self.episode + self.time], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.time = self.episode + 1, 0
        return self.observe(), {}

    def step(self, action):
        self.time += 1
        return self.observe(), 0.0, False, self.time == self.lengths[self.episode - 1], {}


env = gym.wrappers.MaxAndSkipObservation(Counter([8, 9, 2]), skip=4)
last = []
for _ in range(3):
    env.reset()
    ended = False
    while not ended:
        observation, _, _, ended, _ = env.step(0)
    last.append(observation.item())
print(f"gymnasium {gym.__version__}: last observations of episodes of 8, 9 and 2 steps, skip 4")
print(f"  {last}; their last states: [108, 209, 302]")
assert last == [108.0, 208.0, 208.0], last
PY
