#!/usr/bin/env bash
# torchrl 0.14.1: BinarizeReward before RewardSum, to count the rewarded steps of an episode.
#
# Guess: after 200 rewarded steps, episode_reward is 200.
# Seen:  it is -56. The binary rewards are int8, and so is their sum, which wraps at 127: 256 rewarded steps
#        count as none. An agent that succeeds longer looks worse. No warning. Also, the page says "0 or 1 if
#        the reward is null or non-null", but a reward of -1 becomes 0. Without BinarizeReward the sum is
#        right. (envs/transforms/_reward.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import BinarizeReward, Compose, EnvBase, RewardSum, TransformedEnv


class Steady(EnvBase):
    """Every step has the same reward."""

    def __init__(self, reward):
        super().__init__()
        self.value = reward
        self.observation_spec = Composite(observation=Unbounded(1))
        self.action_spec = Unbounded(1)
        self.reward_spec = Unbounded(1)

    def _reset(self, tensordict=None):
        return TensorDict({"observation": torch.zeros(1)}, [])

    def _step(self, tensordict):
        values = {
            "observation": torch.zeros(1),
            "reward": torch.full((1,), self.value),
            "done": torch.zeros(1, dtype=torch.bool),
        }
        return TensorDict(values, [])

    def _set_seed(self, seed):
        torch.manual_seed(seed)


def play(reward, steps, *transforms):
    return TransformedEnv(Steady(reward), Compose(*transforms, RewardSum())).rollout(steps)["next"]


print(f"torchrl {version('torchrl')}: episode_reward of an episode in which each step has reward 1")
found = {}
for steps in (100, 200, 256):
    plain = play(1.0, steps)["episode_reward"][-1].item()
    binary = play(1.0, steps, BinarizeReward())["episode_reward"][-1]
    found[steps] = binary.item()
    print(f"  {steps} steps: {plain:.0f}, with BinarizeReward {binary.item()} ({binary.dtype})")
    assert plain == steps
assert found == {100: 100, 200: -56, 256: 0}, found
negative = play(-1.0, 5, BinarizeReward())["reward"].flatten().tolist()
print(f"  a reward of -1 becomes {negative[0]}")
assert negative == [0] * 5, negative
PY
