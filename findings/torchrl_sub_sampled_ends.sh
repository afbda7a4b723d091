#!/usr/bin/env bash
# torchrl 0.14.1: BatchSubSampler with sub_traj_len, which cuts pieces out of trajectories.
#
# Guess: each piece of five of ten steps is drawn, the last one too.
# Seen:  the last step is never in a piece: starts are drawn below T - length instead of up to it. Of episodes
#        whose reward comes at their end, no reward is ever seen. A piece of nine of ten steps begins at the
#        first step always. No warning. (trainers/trainers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.trainers import BatchSubSampler

torch.manual_seed(0)
data = TensorDict({"step": torch.arange(10)[None], "reward": (torch.arange(10) == 9)[None].float()}, [1, 10])
print(f"torchrl {version('torchrl')}: steps 0 to 9, of which the last has reward 1; 4,000 pieces")
found = {}
for length in (5, 9):
    pieces = BatchSubSampler(batch_size=4000 * length, sub_traj_len=length)(data)
    found[length] = pieces["step"].unique().tolist()
    starts = pieces["step"].reshape(-1, length)[:, 0].unique().tolist()
    print(f"  pieces of {length}: begin at {starts}, steps {found[length]}, reward {pieces['reward'].sum().item():.0f}")
    assert pieces["reward"].sum() == 0
    assert found[length] == list(range(9)), found
PY
