#!/usr/bin/env bash
# torchrl 0.14.1: CompressedListStorage and transitions, whose next observation lies under "next".
#
# Guess: both images of a transition are compressed, and the buffer has its own copy of the data.
# Seen:  only entries at the root are. A nested TensorDict such as "next" is stored uncompressed, as a
#        view of the batch that was passed. Half of the images take their full size, and stay in memory
#        with their whole batch. A caller that writes the next batch into the same tensors changes the
#        next observations and rewards that are stored, but not the observations. No warning.
#        With flat keys such as "next_pixels", everything is compressed and copied.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import CompressedListStorage, ReplayBuffer

ROWS, SHAPE = 10, (3, 64, 64)
RAW = ROWS * 3 * 64 * 64  # bytes of all pixels under "pixels"


def stored(flat):
    pixels = torch.ones(ROWS, *SHAPE, dtype=torch.uint8)
    content = {"pixels": pixels.clone(), "next": {"pixels": pixels, "reward": torch.ones(ROWS, 1)}}
    batch = TensorDict(content, [ROWS])
    if flat:
        batch = batch.flatten_keys("_")
    storage = CompressedListStorage(ROWS)
    buffer = ReplayBuffer(storage=storage, batch_size=ROWS)
    buffer.extend(batch)
    for value in batch.values(include_nested=True, leaves_only=True):
        value.fill_(7)  # the caller uses the tensors again
    row = storage.get(0)
    after = row if flat else row.flatten_keys("_")
    values = {key: int(after[key].max()) for key in ("pixels", "next_pixels", "next_reward")}
    return storage.bytes() / RAW, values


share, values = stored(flat=False)
flat_share, flat_values = stored(flat=True)
print(f"torchrl {version('torchrl')}: two images of ones a row, bytes stored over one image's bytes")
print(f'  under "next": {share:.3f}; the caller writes 7 into its batch, and the buffer has {values}')
print(f"  flat keys: {flat_share:.3f}, {flat_values}")
assert share > 1, 'what lies under "next" is compressed now'
assert values == {"pixels": 1, "next_pixels": 7, "next_reward": 7}, "the buffer has its own copy now"
assert flat_share < 0.1 and set(flat_values.values()) == {1}
PY
