#!/usr/bin/env bash
# torchrl 0.14.1: filter_trajectories(data, 3 < traj.length < 8).
#
# Guess: both conditions hold, or an error as in pandas and for comparisons of steps, which ask for .any()
#        or .all().
# Seen:  the first condition is dropped, since a predicate is always true: trajectories of 2 and 5 steps.
#        `p and q` is q, and `p or q` is p. (TrajectoryPredicate in data/replay_buffers/query.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import filter_trajectories, traj

lengths = [2, 5, 10]
episode = torch.repeat_interleave(torch.arange(3), torch.tensor(lengths))
data = TensorDict({"episode": episode}, [17])
found = {}
for name, predicate in {
    "3 < traj.length < 8": 3 < traj.length < 8,
    "(traj.length > 3) & (traj.length < 8)": (traj.length > 3) & (traj.length < 8),
}.items():
    found[name] = [each.length for each in filter_trajectories(data, predicate, trajectory_key="episode")]
    print(f"torchrl {version('torchrl')}, {name}, lengths {lengths}: selects {found[name]}")
assert list(found.values()) == [[2, 5], [5]], found
PY
