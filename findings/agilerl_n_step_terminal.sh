#!/usr/bin/env bash
# agilerl 2.58.0: n-step rows of its MultiStepReplayBuffer at the end of an episode.
#
# Guess: sums of rewards stop at a terminal step, for every row of an episode.
# Seen:  they stop at a later step of the window, and not at its first one. The row of the terminal
#        step itself adds the rewards of the next episode, has the next episode's observation, and is
#        not marked as done: with n = 3, rewards of 1 and of 10 in the next episode, and a discount of
#        0.5, it holds 1 + 5 + 2.5 = 8.5 in place of 1, and a target bootstraps from it. Every episode
#        has one such row. No warning.
#
# Here: torchrl_bmrl.data.n_step stops at each termination and at the end of each episode.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet agilerl==2.58.0 torch==2.13.0 tensordict==0.13.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from agilerl.components.replay_buffer import MultiStepReplayBuffer
from tensordict import TensorDict

KEYS = ("obs", "reward", "next_obs", "done")
buffer = MultiStepReplayBuffer(32, n_step=3, gamma=0.5)
for first, reward in ((0, 1.0), (100, 10.0)):  # two episodes of four steps that terminate
    for t in range(4):
        numbers = {"obs": first + t, "reward": reward, "next_obs": first + t + 1, "done": t == 3}
        row = {key: torch.tensor([[float(number)]]) for key, number in numbers.items()}
        buffer.add(TensorDict({**row, "action": torch.zeros(1, 1)}, [1]))

print(f"agilerl {version('agilerl')}, MultiStepReplayBuffer: 3-step rows, discount 0.5")
stored = {}
for i in range(len(buffer)):
    obs, *rest = (buffer.storage[key][i].item() for key in KEYS)
    stored[obs] = tuple(rest)
    print(f"  obs {obs}: reward {rest[0]}, next_obs {rest[1]}, done {rest[2]}")
assert stored[0.0] == (1.75, 3.0, 0.0)
assert stored[1.0] == (1.75, 4.0, 1.0)
assert stored[2.0] == (1.5, 4.0, 1.0)
assert stored[3.0] == (8.5, 102.0, 0.0), "the row of the terminal step has changed"
PY
