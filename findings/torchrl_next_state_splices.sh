#!/usr/bin/env bash
# torchrl 0.14.1: NextStateReconstructor behind SliceSampler, its first documented use.
#
# Guess: a row gets the observation of the next row where that row is its next step, and NaN
#        elsewhere, so also between two slices of one trajectory. The page names this case, and says
#        that the done flags tell it.
# Seen:  they tell it only where the first slice ends its trajectory. Where two slices of a long
#        trajectory lie side by side in a batch, the last row of the first gets the first observation
#        of the second, from anywhere in the trajectory. With 4 trajectories of 100 steps that is a
#        quarter of the slices. No warning, no NaN. With step_count_key and a stored step count,
#        which is off by default, it is none.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs.transforms.rb_transforms import NextStateReconstructor

STEPS, LENGTH, SLICE = 400, 100, 4
number = torch.arange(STEPS)


def wrong(**options):
    """Shares of the slices whose last row has NaN, and another row, as its next observation."""
    torch.manual_seed(0)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(STEPS),
        sampler=SliceSampler(slice_len=SLICE, traj_key=("collector", "traj_ids")),
        transform=NextStateReconstructor(**options),
        batch_size=64,
    )
    content = {
        "observation": number[:, None].float(),
        "step_count": number % LENGTH,
        "next": {"done": (number % LENGTH == LENGTH - 1)[:, None]},
        "collector": {"traj_ids": number // LENGTH},
    }
    buffer.extend(TensorDict(content, [STEPS]))
    batch = torch.cat([buffer.sample() for _ in range(200)])
    now = batch["observation"].view(-1, SLICE)
    following = batch["next", "observation"].view(-1, SLICE)
    assert (following[:, :-1] == now[:, :-1] + 1).all(), "wrong inside of slices"
    last = following[:, -1]
    missing = last.isnan()
    other = ~missing & (last != now[:, -1] + 1)
    return missing.float().mean().item(), other.float().mean().item()


missing, other = wrong()
checked_missing, checked_other = wrong(step_count_key="step_count")
print(f"torchrl {version('torchrl')}: next observation of a slice's last row:")
print(f"  NaN {missing:.0%}, of another row {other:.0%}")
print(f"  with step_count_key: NaN {checked_missing:.0%}, of another row {checked_other:.0%}")
assert 0.15 < other < 0.35, "slices of one trajectory are told apart now"
assert checked_other == 0 and checked_missing > 0.95
PY
