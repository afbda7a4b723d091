#!/usr/bin/env bash
# torchrl 0.14.1: RewardScaling with scale=-1, to make rewards of costs.
#
# Guess: as the page says, reward * scale + loc: a cost of 5 becomes a reward of -5.
# Seen:  it becomes 5e-06: the scale is raised to 1e-6, and the sign stays as it was. An agent is trained on
#        rewards a million times too small, of which it is paid for costs. ObservationNorm does the same with
#        a number: with loc 0 and scale -1 the observation 5 becomes 5e-06. No warning.
#        (envs/transforms/_normalization.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.envs.transforms import ObservationNorm, RewardScaling

costs = torch.tensor([[5.0], [-2.0]])
print(f"torchrl {version('torchrl')}: costs 5 and -2")
found = {}
for scale in (2.0, -1.0, -3.0):
    data = TensorDict({"next": {"reward": costs.clone()}}, [2])
    transform = RewardScaling(loc=0.0, scale=scale, in_keys=[("next", "reward")])
    found[scale] = transform(data)["next", "reward"].flatten().tolist()
    print(f"  RewardScaling, scale {scale:.0f}: {found[scale][0]:.3g}, {found[scale][1]:.3g}")
observed = {}
for scale in (2.0, -1.0):
    norm = ObservationNorm(loc=0.0, scale=scale, in_keys=["observation"])
    observed[scale] = norm(TensorDict({"observation": costs.clone()}, [2]))["observation"]
    first, second = observed[scale].flatten().tolist()
    print(f"  ObservationNorm, scale {scale:.0f}: {first:.3g}, {second:.3g}")
assert found[2.0] == [10.0, -4.0], found
close = torch.tensor([5e-6, -2e-6])
assert all(torch.allclose(torch.tensor(found[s]), close) for s in (-1.0, -3.0)), found
assert torch.allclose(observed[-1.0].flatten(), close), observed
PY
