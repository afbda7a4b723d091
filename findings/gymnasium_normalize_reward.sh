#!/usr/bin/env bash
# gymnasium 1.4.0: the scale of NormalizeReward where only the end of an episode is rewarded.
#
# Guess: a return begins at 0 in each episode, so that the scale is the same for one environment and for
#        vector environments of both kinds of automatic reset. Ten steps an episode with a reward of 1 at
#        the last: returns have a deviation of 0.3, and the reward becomes 3.3.
# Seen:  3.3 only in a vector environment that resets in the same step. With the default, reset in the next
#        step, it is 19.7, and with one environment 20.4. The terminal step drops what was summed up
#        before its reward is added, not after: the reward of success begins the next episode's return,
#        which stays near 1, and its variance near 0. If a time limit ends the episode, nothing is ever
#        dropped: returns of all episodes add up, and the reward is 0.9. The scale of the same task differs
#        by a factor of 20 with the kind of end. reset() of one environment does not clear it, either. No
#        warning. (step in wrappers/stateful_reward.py and wrappers/vector/stateful_reward.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.2.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeReward
from gymnasium.wrappers.vector import NormalizeReward as VectorNormalizeReward

STEPS, CALLS = 10, 5000


class Sparse(gymnasium.Env):
    """Ten steps an episode; the last one has a reward of 1."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, terminates):
        self.terminates = terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        end = self.steps == STEPS
        return np.zeros(1, np.float32), float(end), end and self.terminates, end and not self.terminates, {}


def vector(terminates, mode):
    """The normalised reward of success at the end of CALLS steps of four environments."""
    envs = SyncVectorEnv([lambda: Sparse(terminates)] * 4, autoreset_mode=mode)
    envs = VectorNormalizeReward(envs)
    envs.reset()
    return max([envs.step(np.zeros(4, int))[1].max() for _ in range(CALLS)][-2 * STEPS :])


def single(terminates):
    env = NormalizeReward(Sparse(terminates))
    rewards = []
    env.reset()
    for _ in range(CALLS):
        _, reward, terminated, truncated, _ = env.step(0)
        rewards.append(reward)
        if terminated or truncated:
            env.reset()
    return max(rewards[-2 * STEPS :])


true = 1.0 / np.std([0.0] * (STEPS - 1) + [1.0])
print(f"gymnasium {version('gymnasium')}, NormalizeReward: a reward of 1 that ends an episode of {STEPS} steps")
print(f"  by the deviation of the returns: {true:.2f}")
for terminates, end in ((True, "termination"), (False, "time limit")):
    same = vector(terminates, AutoresetMode.SAME_STEP)
    after = vector(terminates, AutoresetMode.NEXT_STEP)
    one = single(terminates)
    print(f"  {end}: reset in the same step {same:.2f}, in the next one {after:.2f}, one environment {one:.2f}")
    assert abs(same - true) < 0.05
    for value in (after, one):
        wrong = value > 5 * true if terminates else value < true / 3
        assert wrong, "returns begin at 0 in each episode now"
PY
