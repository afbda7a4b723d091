#!/usr/bin/env bash
# torchrl 0.14.1: TensorDictMap, which counts or stores by state, for states of more than 16 numbers.
#
# Guess: two different states are two entries, as with 16 numbers or fewer.
# Seen:  states that agree in their first eight significant bits are one: 256 and 257, or 1 and 1.003. Beyond
#        16 numbers the map changes to a random projection, which rounds the state to bfloat16 first. Counts
#        and values of neighbouring states are mixed. No warning. (RandomProjectionHash in data/map/hash.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictMap

print(f"torchrl {version('torchrl')}: is a state found in a map that contains another?")
found = {}
for size in (8, 16, 17, 40):
    for first, second in ((256.0, 257.0), (1.0, 1.003), (1.0, 1.1)):
        x, y = (TensorDict({"state": torch.full((1, size), value)}, [1]) for value in (first, second))
        entry = TensorDict({"count": torch.ones(1, 1)}, [1])
        store = TensorDictMap.from_tensordict_pair(x, entry, in_keys=["state"])
        store[x] = entry
        found[size, second] = store.contains(y).item()
    print(f"  {size} numbers: 257 where 256 is {found[size, 257.0]}, 1.003 where 1 is {found[size, 1.003]}")
assert not any(found[size, second] for size in (8, 16) for second in (257.0, 1.003, 1.1)), found
assert all(found[size, second] for size in (17, 40) for second in (257.0, 1.003)), found
assert not any(found[size, 1.1] for size in (17, 40)), found
PY
