#!/usr/bin/env bash
# torchrl 0.14.1: LogValidationReward, the hook by which its Trainer evaluates a policy.
#
# Guess: "by default, no exploration is used", as the page says of exploration_type, and the logged total is
#        the mean return of the episodes that were played. Episodes of 40 steps with a reward of 1 for
#        the right action have 40.
# Seen:  the default is ExplorationType.RANDOM: actions are drawn from the policy's distribution, and noise
#        modules add their noise. With a deviation of 1, which costs 1.1 a step here, the total is about -6.
#        With ExplorationType.DETERMINISTIC it is 33.3: record_frames = 100 ends within the third episode,
#        and its 20 steps count as an episode. What is logged depends on record_frames, most where few
#        episodes fit in it. No warning. (LogValidationReward in trainers/trainers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0 \
    numpy==2.2.6

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from tensordict.nn import (
    InteractionType,
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torchrl.envs import Compose, ExplorationType, GymWrapper, StepCounter, TransformedEnv
from torchrl.modules import IndependentNormal
from torchrl.trainers import LogValidationReward

STEPS = 40


class Hold(gymnasium.Env):
    """The right action is 0. Its reward is 1, and others have less."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-10, 10, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        reward = 1.0 - 1.1 * float(action[0]) ** 2
        return np.zeros(1, np.float32), reward, False, self.steps == STEPS, {}


network = nn.Linear(1, 2)
nn.init.zeros_(network.weight)
nn.init.zeros_(network.bias)  # a mean of 0 and a deviation of 1
head = TensorDictModule(nn.Sequential(network, NormalParamExtractor()), ["observation"], ["loc", "scale"])
draw = ProbabilisticTensorDictModule(
    ["loc", "scale"],
    ["action"],
    distribution_class=IndependentNormal,
    default_interaction_type=InteractionType.DETERMINISTIC,
)
policy = ProbabilisticTensorDictSequential(head, draw)


def evaluate(frames, **options):
    torch.manual_seed(0)
    environment = TransformedEnv(GymWrapper(Hold()), Compose(StepCounter()))
    hook = LogValidationReward(
        record_interval=1,
        record_frames=frames,
        policy_exploration=policy,
        environment=environment,
        **options,
    )
    return hook(None)["total_r_evaluation"].item()


print(f"torchrl {version('torchrl')}: episodes of {STEPS} steps, worth {STEPS} with the policy's mean action")
deterministic = {"exploration_type": ExplorationType.DETERMINISTIC}
total = evaluate(1000)
print(f"  record_frames 1000: {total:.1f}")
assert total < 10, "the default is without exploration now"
for frames, shown in ((1000, STEPS), (100, 100 / 3), (60, 30), (50, 25)):
    total = evaluate(frames, **deterministic)
    print(f"  record_frames {frames}, ExplorationType.DETERMINISTIC: {total:.1f}")
    assert abs(total - shown) < 0.01, "an episode that is cut off is left out now"
PY
