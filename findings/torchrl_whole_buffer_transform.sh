#!/usr/bin/env bash
# torchrl 0.14.1: reading all of a replay buffer that has a transform, twice.
#
# Guess: buffer[:] gives the transformed rows, as sample() does, and leaves what is stored alone.
# Seen:  buffer[:] hands the storage's own TensorDict to the transform, which writes its results into
#        it: each reading normalises what the last one left. 0 becomes -1, -2, and then also what
#        buffer[0] and sample() give is of numbers normalised several times. No warning.
#
# Here: the storages of data sets hand out a copy of their TensorDict.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import ObservationNorm

norm = ObservationNorm(
    loc=torch.tensor(1.0), scale=torch.tensor(1.0), in_keys=["x"], standard_normal=True
)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=4, transform=norm)
buffer.extend(TensorDict({"x": torch.zeros(4, 1)}, [4]))
first = buffer.sample()["x"].mean().item(), buffer.sample()["x"].mean().item()
whole = [buffer[:]["x"].mean().item() for _ in range(3)]
after = buffer.sample()["x"].mean().item()
print(f"torchrl {version('torchrl')}: sample() twice {first}, buffer[:] three times {whole},")
print(f"  sample() afterwards {after}; 0 normalised once is -1")
assert first == (-1.0, -1.0), "sample() changes what is stored"
assert whole == [-1.0, -2.0, -3.0], "buffer[:] now leaves what is stored alone"
assert after == -4.0, "what is stored has been left alone"
PY
