#!/usr/bin/env bash
# torchrl 0.14.1: ReplayBufferTrainer(flatten_tensordicts=True), as the trainers of SAC, TD3 and
# others make it.
#
# Guess: the batch [B, T] is flattened, and the last step of each of the B rows is marked as truncated.
# Seen:  every step is marked as truncated, in the buffer and in the collector's batch, since the entries
#        are [B, T, 1] and the last index is that of their single component. done stays as it was. Losses
#        read done and terminated, but whatever splits the buffer into trajectories by truncated finds
#        trajectories of one step. (extend in trainers/trainers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.trainers import ReplayBufferTrainer

flags = {name: torch.zeros(2, 5, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
batch = TensorDict(
    {"observation": torch.zeros(2, 5, 3), "next": TensorDict({"reward": torch.zeros(2, 5, 1), **flags}, [2, 5])},
    [2, 5],
)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), batch_size=4)
ReplayBufferTrainer(buffer, batch_size=4, flatten_tensordicts=True).extend(batch)
stored = buffer[:]["next"]
truncated, done = int(stored["truncated"].sum()), int(stored["done"].sum())
print(f"torchrl {version('torchrl')}: of 2 x 5 steps {truncated} are truncated (two rows: 2) and {done} done")
assert (truncated, done) == (10, 0), (truncated, done)
PY
