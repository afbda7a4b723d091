#!/usr/bin/env bash
# torchrl 0.14.1: a batch without one of the keys that the replay buffer has.
#
# Guess: extend() raises an error, or fills the missing entry with zeros.
# Seen:  the entry keeps what lay in its place. In a full buffer, transitions without "success" have the
#        success of the old transition that they replace, and those without ("next", "terminated") end
#        where it ended. In rows that were not used before, LazyTensorStorage has whatever lay in
#        memory, and LazyMemmapStorage zeros. No warning. A key that is too many is added to the
#        former, and dropped by the latter.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer


def rows(first, count, **more):
    content = {"step": torch.arange(first, first + count), "next": {"reward": torch.zeros(count, 1)}}
    batch = TensorDict(content, [count])
    for key, value in more.items():
        batch["next", key] = torch.full((count, 1), value)
    return batch


for storage in (LazyTensorStorage, LazyMemmapStorage):
    buffer = ReplayBuffer(storage=storage(4))
    buffer.extend(rows(0, 4, success=True, terminated=True))
    buffer.extend(rows(4, 2))
    step, data = buffer[:]["step"].tolist(), buffer[:]["next"]
    success = data["success"].flatten().tolist()
    terminated = data["terminated"].flatten().tolist()
    print(f"torchrl {version('torchrl')}, {storage.__name__}: steps {step}, 4 and 5 without the keys:")
    print(f"  success {success}, terminated {terminated}")
    assert step == [4, 5, 2, 3]
    assert success == terminated == [True] * 4, "the old rows' values are gone now"

    buffer.extend(rows(6, 1, success=False, terminated=False, late=True))
    late = buffer[:]["next"].get("late", None)
    print(f"  one key too many: {'dropped' if late is None else 'stored'}")
    assert (late is None) == (storage is LazyMemmapStorage)
    assert buffer[:]["next", "success"].flatten().tolist() == [True, True, False, True]
PY
