#!/usr/bin/env bash
# torchrl 0.14.1: TensorDictReplayBuffer with data that has an entry 'index', as LeRobot's frames
# have.
#
# Guess: a buffer returns what was stored.
# Seen:  the entry is replaced by the row numbers of the buffer. A plain ReplayBuffer keeps it. No warning.
#        (extend in data/replay_buffers/writers/round_robin.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

seen = {}
for kind in (ReplayBuffer, TensorDictReplayBuffer):
    data = TensorDict({"index": torch.tensor([70, 71, 72])}, [3])
    buffer = kind(storage=LazyTensorStorage(3))
    buffer.extend(data)
    seen[kind.__name__] = buffer[:]["index"].tolist()
    print(f"torchrl {version('torchrl')}, {kind.__name__}: given 70, 71, 72, returns {seen[kind.__name__]}")
assert seen == {"ReplayBuffer": [70, 71, 72], "TensorDictReplayBuffer": [0, 1, 2]}, seen
PY
