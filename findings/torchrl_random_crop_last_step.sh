#!/usr/bin/env bash
# torchrl 0.14.1: RandomCropTensorDict, which cuts windows at random out of stored trajectories.
#
# Guess: each window of sub_seq_len steps is as likely as any other, the last one included.
# Seen:  the last one is never cut. Of trajectories with 20 steps, step 20 is in none of 10,000 windows:
#        the step with the termination, and with the reward where only success is rewarded. All rewards
#        of a data set of successful demonstrations are 0 after cropping. No warning. With mask_key, for
#        trajectories of different lengths, the last valid step of each is left out in the same way,
#        unless the trajectory is exactly as long as the window. (The upper bounds of both draws in
#        RandomCropTensorDict.forward, envs/transforms/_misc.py, are too low by one.)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import RandomCropTensorDict

STEPS, WINDOW, COUNT = 20, 5, 10_000


def crops(lengths, **options):
    """Windows of a buffer with a trajectory of each of these lengths, rewarded at its last step."""
    step = torch.arange(1, STEPS + 1).expand(len(lengths), STEPS)
    length = torch.tensor(lengths)[:, None].expand_as(step)
    reward = (step == length).float()[..., None]
    data = {"step": step, "length": length, "mask": step <= length, "next": {"reward": reward}}
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(lengths)),
        transform=RandomCropTensorDict(WINDOW, **options),
        batch_size=COUNT,
    )
    buffer.extend(TensorDict(data, [len(lengths), STEPS]))
    return buffer.sample()


torch.manual_seed(0)
print(f"torchrl {version('torchrl')}: {COUNT} windows of {WINDOW} steps")
windows = crops([STEPS] * 3)
found = windows["step"].unique().tolist()
rewards = windows["next", "reward"].sum().item()
print(f"  trajectories of {STEPS} steps: steps {found[0]} to {found[-1]}, sum of rewards {rewards:.0f}")
assert windows.shape == (COUNT, WINDOW)
assert found == list(range(1, STEPS)) and rewards == 0, "the last step is cut out now"

windows = crops([12, 16], mask_key="mask")
for length in (12, 16):
    found = windows["step"][windows["length"] == length].unique().tolist()
    print(f"  with mask_key, a trajectory of {length} steps: steps {found[0]} to {found[-1]}")
    assert found == list(range(1, length)), "the last valid step is cut out now"
assert windows["next", "reward"].sum() == 0
PY
