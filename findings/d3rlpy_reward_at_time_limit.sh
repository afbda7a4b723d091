#!/usr/bin/env bash
# d3rlpy 2.8.1: episodes that a time limit ends, with the reward for success at their last step.
#
# Guess: MDPDataset(..., timeouts=...) trains on every step, and bootstraps after the last one. Or an
#        error says that the observation after it is needed.
# Seen:  the last step of such an episode is in no transition, so its reward is never seen. If success
#        is rewarded there, all sampled rewards are 0, while compute_return() of the episodes is 1 for
#        each success. ReturnBasedRewardScaler then divides by 0, and a reward becomes NaN. No
#        warning. There is no argument for the observation after the last step. With the same flags
#        as terminals, all steps are there.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 d3rlpy==2.8.1

"$folder/venv/bin/python" -W ignore - <<'PY' 2>"$folder/log" | grep '^d3rlpy' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import numpy as np
from d3rlpy.dataset import MDPDataset
from d3rlpy.preprocessing import ReturnBasedRewardScaler

EPISODES, STEPS = 20, 5
number = np.arange(EPISODES * STEPS)
last = (number % STEPS == STEPS - 1).astype("f4")
success = last * (number // STEPS % 2)  # every other episode
observations = number[:, None].astype("f4")
actions = np.random.default_rng(0).uniform(-1, 1, (len(number), 1)).astype("f4")


def count(terminals, timeouts):
    data = MDPDataset(observations, actions, success, terminals, timeouts=timeouts)
    returns = sum(episode.compute_return() for episode in data.episodes)
    rewards = data.sample_transition_batch(2000).rewards
    scaler = ReturnBasedRewardScaler()
    scaler.fit_with_transition_picker(data.episodes, data.transition_picker)
    scaled = scaler.transform_numpy(rewards)
    return data.transition_count, float(returns), float(rewards.max()), bool(np.isnan(scaled).any())


for name, flags in (("terminals", (last, None)), ("timeouts", (0 * last, last))):
    transitions, returns, largest, nan = count(*flags)
    print(f"d3rlpy {version('d3rlpy')}, {name}: {transitions} of {len(number)} steps are sampled;", end=" ")
    print(f"returns add up to {returns}, the largest sampled reward is {largest}, scaled NaN {nan}", flush=True)
    wanted = (100, 10.0, 1.0, False) if name == "terminals" else (80, 10.0, 0.0, True)
    assert (transitions, returns, largest, nan) == wanted, "last steps are sampled now"
PY
