#!/usr/bin/env bash
# imitation 1.0.1, stable-baselines3 2.2.1: the demonstrated actions in SQIL with SAC or TD3.
#
# Guess: a policy that imitates a demonstrator who always applies a torque of 0.6 applies 0.6. The page
#        of the replay buffer says that it "can be used in off-policy algorithms like DQN/SAC/TD3".
# Seen:  it applies 1.2. Stable-Baselines3 stores the learner's actions scaled from the bounds of the
#        action space, here -2 and 2, to -1 and 1. SQIL stores the demonstrated ones as they are, in the
#        same batches. 0.6 in the buffer means 1.2 to the critic and to the policy. Actions near the
#        bounds lie outside of what the policy can express. No warning. With a space from -1 to 1 it is
#        right. (SQILReplayBuffer.set_demonstrations in algorithms/sqil.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet imitation==1.0.1 stable-baselines3==2.2.1 torch==2.13.0 \
    numpy==1.26.4 gymnasium==0.29.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
from imitation.algorithms.sqil import SQIL
from imitation.data.types import Transitions
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv

TORQUE, ROWS = 0.6, 500


class Motor(gymnasium.Env):
    """Observations at random, episodes of 10 steps, and a torque as the action."""

    def __init__(self, bound):
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-bound, bound, (1,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        return self.observe(), 0.0, self.steps == 10, False, {}

    def observe(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)


observations = np.random.default_rng(0).uniform(-1, 1, (ROWS, 2)).astype(np.float32)
demonstrations = Transitions(
    obs=observations,
    acts=np.full((ROWS, 1), TORQUE, np.float32),
    infos=np.array([{}] * ROWS),
    next_obs=np.roll(observations, -1, axis=0),
    dones=np.arange(ROWS) % 10 == 9,
)

print(f"imitation {version('imitation')}, SQIL: demonstrated torque {TORQUE}")
for kind in (SAC, TD3):
    for bound in (1.0, 2.0):
        options = {"learning_starts": 100, "learning_rate": 1e-3, "gamma": 0.5, "batch_size": 64}
        options |= {"policy_kwargs": {"net_arch": [32, 32]}, "seed": 0}
        if kind is SAC:
            options["ent_coef"] = 0.01
        algorithm = SQIL(
            venv=DummyVecEnv([lambda bound=bound: Motor(bound)]),
            demonstrations=demonstrations,
            policy="MlpPolicy",
            rl_algo_class=kind,
            rl_kwargs=options,
        )
        algorithm.train(total_timesteps=1500)
        buffer = algorithm.rl_algo.replay_buffer
        torque = algorithm.policy.predict(observations, deterministic=True)[0].mean()
        stored = buffer.expert_buffer.actions.mean()
        print(f"  {kind.__name__}, bounds of {bound:.0f}: stored as {stored:.1f}, imitated as {torque:.2f}")
        assert np.abs(buffer.actions).max() <= 1  # the learner's, scaled
        assert abs(stored - TORQUE) < 1e-6, "demonstrated actions are scaled now"
        assert abs(torque - bound * TORQUE) < 0.1, torque
PY
