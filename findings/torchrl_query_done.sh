#!/usr/bin/env bash
# torchrl 0.14.1: filter_trajectories(data, (traj.terminated == True).any()), data in TorchRL's
# format.
#
# Guess: the trajectories that ended by termination: traj.done and traj.reward give the entries after the
#        step, says the documentation of Trajectory.
# Seen:  none. A name is looked up at the root first, and every rollout and collector has done, terminated
#        and truncated there, as they were before the step, which is always False. ~(...) selects all.
#        traj['next', 'terminated'] works. Rewards are right, since the root has none.
#        (data/replay_buffers/query.py)
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

ended = torch.zeros(6, 1, dtype=torch.bool)
ended[2] = True  # of the first trajectory; the second one is cut off
last = ended.clone()
last[5] = True
data = TensorDict(
    {
        "episode": torch.tensor([0, 0, 0, 1, 1, 1]),
        "done": torch.zeros(6, 1, dtype=torch.bool),
        "terminated": torch.zeros(6, 1, dtype=torch.bool),
        "next": TensorDict({"done": last, "terminated": ended}, [6]),
    },
    [6],
)
found = {}
for name, predicate in {
    "(traj.terminated == True).any()": (traj.terminated == True).any(),  # noqa: E712
    "(traj['next', 'terminated'] == True).any()": (traj["next", "terminated"] == True).any(),  # noqa: E712
}.items():
    found[name] = len(filter_trajectories(data, predicate, trajectory_key="episode"))
    print(f"torchrl {version('torchrl')}, {name}: {found[name]} of 2 trajectories; terminated: 1")
assert list(found.values()) == [0, 1], found
PY
