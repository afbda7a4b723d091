#!/usr/bin/env bash
# stable-baselines3 2.9.2: the last observation of an episode in a replay buffer, with VecNormalize.
#
# Guess: the buffer holds the observations of the environment, unnormalised, as its docstring says; they are
#        normalised when they are sampled.
# Seen:  all but the last next_observation of each episode, which was normalised and clipped to ten deviations
#        and is turned back afterwards. A sensor that is 0 until the last step, where it is 5, is stored as
#        0.03. With a time limit, values bootstrap from this row; hindsight goals ("final") read it, and so
#        do those who use saved buffers as offline data. No warning. Without VecNormalize it is right.
#        (step_wait in common/vec_env/vec_normalize.py, _store_transition in common/off_policy_algorithm.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet stable-baselines3==2.9.2 torch==2.13.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import numpy as np
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


class Door(gym.Env):
    """Time, and a sensor that is 5 at the last of ten steps and 0 before."""

    observation_space = gym.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def observe(self):
        return np.array([self.time / 10, 5.0 if self.time == 10 else 0.0], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.observe(), {}

    def step(self, action):
        self.time += 1
        return self.observe(), 0.0, False, self.time == 10, {}


def stored(normalised):
    environments = DummyVecEnv([Door])
    if normalised:
        environments = VecNormalize(environments)
    model = TD3("MlpPolicy", environments, learning_starts=10_000, buffer_size=1000, seed=0)
    model.learn(200)
    rows = model.replay_buffer
    last = rows.dones[: rows.pos] == 1
    return rows.next_observations[: rows.pos][last][:, 1], rows.next_observations[: rows.pos][~last]


plain, _ = stored(False)
found, others = stored(True)
print(f"stable-baselines3 {version('stable-baselines3')}: the sensor at the last step of an episode")
print(f"  buffer of TD3: {plain[0]:.3f}; with VecNormalize: {found[0]:.6f} to {found.max():.6f}")
assert (plain == 5.0).all()
assert len(found) == 20 and found.max() < 0.1, found
times = np.arange(1, 10) / 10
assert np.allclose(others[:9, 0], times), others[:9]  # the other rows are right
PY
