#!/usr/bin/env bash
# torchrl 0.14.1: SliceSampler(slice_len=10, span=(0, 1)).
#
# Guess: slices have at least 9 steps: with a span of i, at least slice_len - i are gathered, says the
#        documentation.
# Seen:  slices have 2 to 10 steps. On the right the span is the number of steps that are kept, not of
#        those that may be missing: span=(0, 9) gives full slices only. The left side is as documented.
#        (_get_index in data/replay_buffers/samplers/slice.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

torch.manual_seed(0)
found = {}
for span in ((0, 1), (0, 9), (1, 0), (9, 0)):
    sampler = SliceSampler(slice_len=10, span=span, traj_key="episode")
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=sampler, batch_size=1000)
    buffer.extend(TensorDict({"step": torch.arange(20), "episode": torch.zeros(20, dtype=torch.int)}, [20]))
    steps = torch.cat([buffer.sample().get("step") for _ in range(10)])
    cuts = (steps[1:] != steps[:-1] + 1).nonzero().flatten() + 1
    lengths = cuts.diff()  # of slices; two that happen to continue each other count as one
    found[span] = lengths.min().item()
    print(f"torchrl {version('torchrl')}, span={span}: the shortest slice has {found[span]} steps;")
    print(f"  documented: {10 - max(span)}")
assert found == {(0, 1): 2, (0, 9): 10, (1, 0): 9, (9, 0): 1}, found
PY
