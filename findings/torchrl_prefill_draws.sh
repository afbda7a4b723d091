#!/usr/bin/env bash
# torchrl 0.14.1: prefill_replay_buffer, which copies an offline data set into a buffer.
#
# Guess: without n_samples the whole data set is copied, as the page says: every row once.
# Seen:  it draws as many rows as the data set has, with replacement: of 10,000 rows 63 % are in the
#        copy, others several times, all in random order, so that episodes are lost. The length of the
#        copy is right. No warning. buffer.extend(dataset[:]) copies every row, in order.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.offline_to_online import prefill_replay_buffer

SIZE = 10_000
torch.manual_seed(0)
dataset = ReplayBuffer(storage=LazyTensorStorage(SIZE))
dataset.extend(TensorDict({"row": torch.arange(SIZE)}, [SIZE]))
copy = ReplayBuffer(storage=LazyTensorStorage(SIZE))
prefill_replay_buffer(copy, dataset)
whole = ReplayBuffer(storage=LazyTensorStorage(SIZE))
whole.extend(dataset[:])

rows = copy[:]["row"]
share = rows.unique().numel() / SIZE
most = rows.bincount().max().item()
print(f"torchrl {version('torchrl')}: the copy has {len(copy)} rows, {share:.1%} of the data set's rows,")
print(f"  one of them {most} times; its first rows are {rows[:5].tolist()}")
assert len(copy) == SIZE
assert 0.6 < share < 0.66, "the copy now contains another share of the rows"
assert torch.equal(whole[:]["row"], torch.arange(SIZE)), "extend() does not copy every row"
PY
