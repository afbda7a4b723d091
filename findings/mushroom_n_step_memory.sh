#!/usr/bin/env bash
# mushroom-rl 1.10.2: n_steps_return of Rainbow and of its replay memories.
#
# Guess: with core.learn(n_steps_per_fit=1), as for any of its DQNs, each step is stored once its n steps
#        are known, and the agent learns. The last steps of an episode have shorter sums.
# Seen:  nothing is ever stored, and the agent does not learn. The memory makes rows out of one call's data
#        only: a call with fewer than n steps adds none, and one with 4 steps, as usual on Atari, at most
#        2 with n = 3. After 400 steps the network has the weights it started with, and training reports
#        its episodes as usual. No warning. The last n - 1 steps of each episode are never stored in any
#        case. With n = 1 all steps are. (ReplayMemory.add and SumTree.add in utils/replay_memory.py)
#
# Of what the package pins, torch 2.5.1 is replaced by a newer one, and opencv by its headless build.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps mushroom-rl==1.10.2
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==1.24.4 scipy==1.15.2 scikit-learn==1.6.1 \
    matplotlib==3.10.1 joblib==1.4.2 tqdm==4.67.1 pygame==2.6.1 opencv-python-headless==4.11.0.86

"$folder/venv/bin/python" -W ignore - <<'PY' | grep -v '^pygame\|^Hello'
from importlib.metadata import version

import numpy as np
import torch
from mushroom_rl.algorithms.value import Rainbow
from mushroom_rl.core import Core, Environment, MDPInfo
from mushroom_rl.policy import EpsGreedy
from mushroom_rl.utils.parameters import Parameter
from mushroom_rl.utils.replay_memory import ReplayMemory
from mushroom_rl.utils.spaces import Box, Discrete
from torch import nn

STEPS = 400


class Corridor(Environment):
    """Ten steps an episode, a reward of 1 at the last."""

    def __init__(self):
        super().__init__(MDPInfo(Box(0, 1, (1,)), Discrete(2), 0.9, 10))

    def reset(self, state=None):
        self.steps = 0
        return np.zeros(1)

    def step(self, action):
        self.steps += 1
        return np.array([self.steps / 10]), float(self.steps == 10), self.steps == 10, {}


class Features(nn.Module):
    def __init__(self, input_shape, output_shape, n_features, **options):
        super().__init__()
        self.layer = nn.Linear(input_shape[0], n_features)

    def forward(self, state):
        return torch.relu(self.layer(state.float()))


def train(n, per_fit):
    """How many rows are stored, and whether the weights have changed."""
    np.random.seed(0)
    torch.manual_seed(0)
    environment = Corridor()
    network = {"network": Features, "input_shape": (1,), "output_shape": (2,), "n_actions": 2}
    network |= {"n_features": 8, "optimizer": {"class": torch.optim.Adam, "params": {"lr": 1e-3}}}
    agent = Rainbow(
        environment.info, EpsGreedy(epsilon=Parameter(1.0)), network, n_atoms=11, v_min=0.0, v_max=1.0,
        n_steps_return=n, alpha_coeff=0.6, beta=Parameter(0.4), batch_size=8,
        target_update_frequency=10, initial_replay_size=16, max_replay_size=1000,
    )
    before = agent.approximator.get_weights().copy()
    Core(agent, environment).learn(n_steps=STEPS, n_steps_per_fit=per_fit, quiet=True)
    same = np.array_equal(before, agent.approximator.get_weights())
    return agent._replay_memory._tree.size, not same


print(f"mushroom-rl {version('mushroom-rl')}, Rainbow: {STEPS} steps in episodes of 10")
for n, per_fit, expected in ((1, 1, STEPS), (3, 1, 0), (3, 2, 0), (3, 4, None), (3, 100, 320)):
    stored, learned = train(n, per_fit)
    print(f"  n_steps_return={n}, n_steps_per_fit={per_fit}:", end=" ")
    print(f"{stored} rows stored, weights {'changed' if learned else 'as at first'}")
    assert learned == (stored > 0)
    assert stored == expected if expected is not None else stored <= STEPS / 2, "rows are kept now"

memory = ReplayMemory(0, 100)
for t in range(10):
    row = (np.array([t]), np.array([0]), 1.0, np.array([t + 1]), t == 9, t == 9)
    memory.add([row], n_steps_return=3, gamma=0.9)
print(f"  ReplayMemory.add() of ten single steps with n = 3: {memory.size} rows")
assert memory.size == 0
PY
