#!/usr/bin/env bash
# torchrl 0.14.1: Reward2GoTransform and a batch whose last episode is not finished.
#
# Guess: the page says that the reward to go can only be calculated once the episode is finished. Steps
#        of an unfinished episode raise an error or are marked.
# Seen:  one finished episode in the batch is enough. The steps after it get the sum up to the end of
#        the batch, as if the episode ended there. With episodes of 6 steps, a reward of 1 a step and
#        batches of 8, the seventh step has a reward to go of 2 instead of 6. No warning. Only a batch
#        without any end raises the error. With batches of whole episodes all numbers are right.
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
from torchrl.envs.transforms import Reward2GoTransform

STEPS, LENGTH = 24, 6
number = torch.arange(STEPS)
done = (number % LENGTH == LENGTH - 1)[:, None]
data = TensorDict({"next": {"reward": torch.ones(STEPS, 1), "done": done}}, [STEPS])
right = (LENGTH - number % LENGTH).float()


def stored(size):
    transform = Reward2GoTransform(gamma=1.0, out_keys=["to_go"])
    buffer = ReplayBuffer(storage=LazyTensorStorage(STEPS), transform=transform)
    for batch in data.clone().split(size):
        buffer.extend(batch)
    return buffer[:]["to_go"].flatten()


whole, cut = stored(12), stored(8)
print(f"torchrl {version('torchrl')}: reward to go, batches of 12 {whole.int().tolist()},")
print(f"  batches of 8 {cut.int().tolist()}")
assert torch.equal(whole, right), "wrong with whole episodes"
assert cut[6:8].tolist() == [2.0, 1.0] and right[6:8].tolist() == [6.0, 5.0], "other numbers now"
try:
    stored(4)
except RuntimeError as error:
    assert "No episode ends" in str(error)
else:
    raise AssertionError("a batch without an end is accepted now")
PY
