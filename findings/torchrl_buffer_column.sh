#!/usr/bin/env bash
# torchrl 0.14.1: buffer["reward"] = values, to relabel what a replay buffer contains.
#
# Guess: the entry is written, as buffer[:] and buffer[3] show and as in a TensorDict. Otherwise there is
#        an error.
# Seen:  a buffer that is not full is left as it was: the values go into a temporary copy. A full one is
#        changed. Neither warns. The same holds for nested keys. (__setitem__ in
#        data/replay_buffers/replay_buffers/base.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

seen = {}
for size in (10, 20):
    buffer = ReplayBuffer(storage=LazyTensorStorage(size))
    buffer.extend(TensorDict({"reward": torch.zeros(10, 1)}, [10]))
    buffer["reward"] = torch.ones(10, 1)
    seen[size] = buffer[:]["reward"].sum().item()
    print(f"torchrl {version('torchrl')}, 10 rows of {size}: sum of rewards {seen[size]}; set: 10 ones")
assert seen == {10: 10.0, 20: 0.0}, seen
PY
