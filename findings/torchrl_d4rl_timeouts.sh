#!/usr/bin/env bash
# torchrl 0.14.1: D4RLExperienceReplay and episodes that end by a time limit.
#
# Guess: a time limit truncates: the value of the observation after it counts. Where the file has
#        next_observations, the transition has the one of the file. All transitions of the file are
#        there.
# Seen:  the observation after a time limit is replaced by zeros, as after a termination (the page
#        says so of "done" states), but it is not marked as terminated. Losses bootstrap from the
#        value of the zeros. use_truncated_as_done=False leaves it alone. Without next_observations it
#        is then the first observation of the next episode, from which losses bootstrap. The last
#        transition is always left out, also if its next observation is known. No warning.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 h5py==3.16.0

RL_WARNINGS=False "$folder/venv/bin/python" - "$folder" <<'PY'
import sys
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torchrl.data.datasets.d4rl import D4RL_DATASETS, D4RLExperienceReplay
from torchrl.objectives.value import TD0Estimator

folder = Path(sys.argv[1])
step = np.arange(9)  # three episodes of three steps; the second one terminates
observation = (100 * (step // 3) + step % 3 + 1).astype("f4")[:, None]
value = TensorDictModule(torch.nn.Identity(), ["observation"], ["state_value"])


def load(name, next_observations, **options):
    """A file in D4RL's layout, in place of the download; next observations and TD targets."""
    with h5py.File(folder / f"{name}.hdf5", "w") as file:
        file["observations"] = observation
        file["actions"] = np.zeros((9, 1), "f4")
        file["rewards"] = np.zeros(9, "f4")
        file["terminals"] = step == 5
        file["timeouts"] = (step == 2) | (step == 8)
        if next_observations:
            file["next_observations"] = observation + 1
    D4RL_DATASETS[name] = (folder / f"{name}.hdf5").as_uri()
    data = D4RLExperienceReplay(
        name, 4, root=folder / "converted", direct_download=True, **options
    )[:].clone()
    assert data["next", "truncated"].flatten().tolist() == [s == 2 for s in range(8)]
    assert data["next", "terminated"].flatten().tolist() == [s == 5 for s in range(8)]
    # The value of an observation is the observation itself, gamma is 1, rewards are 0.
    target = TD0Estimator(gamma=1.0, value_network=value).value_estimate(data)
    return data["next", "observation"].flatten().tolist(), target.flatten().tolist()


print(f"torchrl {version('torchrl')}: observations {observation.flatten().tolist()}")
seen = {}
for name, next_observations, options in (
    ("known", True, {}),
    ("known, use_truncated_as_done=False", True, {"use_truncated_as_done": False}),
    ("unknown", False, {}),
    ("unknown, use_truncated_as_done=False", False, {"use_truncated_as_done": False}),
):
    following, target = load(f"d{len(seen)}-v0", next_observations, **options)
    seen[name] = following[2], target[2]
    print(f"  next ones {name}: {following}, target at the time limit {target[2]}")
    assert len(following) == 8, "the last transition is there now"
    assert following[5] == target[5] == 0.0, "other numbers after the termination"
assert list(seen.values()) == [(0.0, 0.0), (4.0, 4.0), (0.0, 0.0), (101.0, 101.0)], seen
PY
