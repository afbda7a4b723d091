#!/usr/bin/env bash
# torchrl 0.14.1: DensifyReward on data whose time is not the last dimension.
#
# Guess: time_dim says along which dimension of the TensorDict an episode runs.
# Seen:  it is never read. The sum runs along the dimension before the reward's last one, whatever
#        time_dim is. For data [time, episodes] and time_dim=0, a reward at an episode's end stays
#        there, and an episode that is not finished gets the next one's reward added. No warning. For
#        data [episodes, time], each step gets the reward of its episode's end.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import DensifyReward

reward, done = torch.zeros(2, 4, 1), torch.zeros(2, 4, 1, dtype=torch.bool)
reward[0, 3], reward[1, 3] = 3, 7
done[0, 3] = done[1, 3] = True
episodes_first = TensorDict({"next": {"reward": reward, "done": done}}, [2, 4])
unfinished = episodes_first.clone()
unfinished["next", "done"][0] = False  # the first episode goes on


def dense(data, **options):
    return DensifyReward(**options)(data.clone())["next", "reward"].squeeze(-1)


right = dense(episodes_first)
time_first = episodes_first.transpose(0, 1).contiguous()
wrong = dense(time_first, time_dim=0).T
mixed = dense(unfinished.transpose(0, 1).contiguous(), time_dim=0).T
print(f"torchrl {version('torchrl')}: [episodes, time] {right.tolist()}")
print(f"  [time, episodes], time_dim=0: {wrong.tolist()};")
print(f"  the first episode unfinished: {mixed.tolist()}")
assert right.tolist() == [[3.0] * 4, [7.0] * 4]
assert wrong.tolist() == [[0.0, 0.0, 0.0, 3.0], [0.0, 0.0, 0.0, 7.0]], "time_dim is read now"
assert mixed[0].tolist() == [0.0, 0.0, 0.0, 10.0], "episodes are no longer mixed"
PY
