#!/usr/bin/env bash
# d3rlpy 2.8.1: a Decision Transformer with a reward scaler, exported by save_policy.
#
# Guess: as the page of preprocessing says, each preprocessor is part of the exported model: the policy takes
#        returns in the unit of the data, as as_stateful_wrapper does.
# Seen:  scalers of observations and actions are part of it, the reward scaler is not. With a scaler of 0.001,
#        the target return 300 is read as 300,000, and the action is that of another return; one has to give
#        0.3. No warning. (save_policy in algos/transformer/base.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 d3rlpy==2.8.1

cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import d3rlpy
import numpy as np
import torch

EPISODES, STEPS = 500, 5
d3rlpy.seed(0)
rng = np.random.default_rng(0)
# The action of an episode is a number, its return 1000 times that number.
number = rng.uniform(0, 0.9, (EPISODES, 1)).astype(np.float32)
rewards = np.zeros((EPISODES * STEPS, 1), np.float32)
rewards[STEPS - 1 :: STEPS] = 1000 * number
ends = np.zeros(EPISODES * STEPS, np.float32)
ends[STEPS - 1 :: STEPS] = 1
data = d3rlpy.dataset.MDPDataset(
    np.zeros((EPISODES * STEPS, 2), np.float32),
    np.repeat(number, STEPS, 0),
    rewards,
    ends,
    action_space=d3rlpy.ActionSpace.CONTINUOUS,
)
agent = d3rlpy.algos.DecisionTransformerConfig(
    context_size=1,
    learning_rate=1e-3,
    reward_scaler=d3rlpy.preprocessing.MultiplyRewardScaler(0.001),
).create()
agent.fit(
    data,
    n_steps=1000,
    n_steps_per_epoch=1000,
    show_progress=False,
    logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
)
agent.save_policy("policy.pt")
policy = torch.jit.load("policy.pt")


def exported(target):
    returns, time = torch.full((1, 1), float(target)), torch.ones(1, dtype=torch.long)
    return policy(torch.zeros(1, 2), torch.zeros(1, 1), returns, time).item()


print(f"d3rlpy {version('d3rlpy')}: actions, which are a thousandth of the return")
found = []
for target in (100.0, 300.0, 600.0):
    inside = agent.as_stateful_wrapper(target_return=target).predict(np.zeros(2, np.float32), 0.0).item()
    row = (inside, exported(target), exported(target / 1000))
    found.append(row)
    print(
        f"  target {target:.0f}: in the library {row[0]:.2f}, exported {row[1]:.2f};"
        f" exported, target {target / 1000}: {row[2]:.2f}"
    )
for inside, whole, scaled in found:
    assert abs(inside - scaled) < 1e-3, found
assert max(abs(inside - whole) for inside, whole, _ in found) > 0.2, found
assert found[2][0] - found[0][0] > 0.3, found
PY
