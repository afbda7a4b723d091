#!/usr/bin/env bash
# torchrl 0.14.1: SuccessReward on a replay buffer of transitions, for sparse rewards from success flags.
#
# Guess: the rewards that losses read, ("next", "reward"), become 1 where the step succeeded and 0
#        elsewhere, as on an environment. The page says that it can be applied to sampled data.
# Seen:  it reads "success", the flag of the state before the action, and writes "reward" beside it.
#        ("next", "reward") keeps its old numbers, and losses go on with them: the loss is the same to
#        the last bit with and without the transform. Also, the new reward is one step late, and the
#        success that ends an episode has none. No warning. With both keys under "next" it is right.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - 2>"$folder/log" <<'PY' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import SuccessReward
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss


def column(*values):
    return torch.tensor(values)[:, None]


# An episode of four steps with dense rewards, whose last step succeeds.
ends = column(False, False, False, True)
after = {"observation": column(1.0, 2.0, 3.0, 4.0), "success": ends, "reward": column(0.1, 0.2, 0.3, 0.4)}
data = TensorDict(
    {
        "observation": column(0.0, 1.0, 2.0, 3.0),
        "success": column(False, False, False, False),
        "action": column(0.5, 0.5, 0.5, 0.5),
        "next": {**after, "done": ends, "terminated": ends.clone()},
    },
    [4],
)
torch.manual_seed(0)
actor = TensorDictModule(nn.Linear(1, 1), ["observation"], ["action"])
critic = ValueOperator(nn.Bilinear(1, 1, 1), in_keys=["observation", "action"])
loss = DDPGLoss(actor, critic)


def sample(*transforms):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
    for transform in transforms:
        buffer.append_transform(transform)
    buffer.extend(data.clone())
    rows = buffer[:].clone()
    return rows, loss(rows)["loss_value"].item()


def show(values):
    return [round(value, 1) for value in values.flatten().tolist()]


plain, before = sample()
rows, with_transform = sample(SuccessReward())
right, mended = sample(SuccessReward(("next", "success"), ("next", "reward")))
print(f"torchrl {version('torchrl')}: the last of four steps succeeds")
print(f"  without the transform: next reward {show(plain['next', 'reward'])}, loss {before:.4f}")
print(f"  SuccessReward(): next reward {show(rows['next', 'reward'])}, loss {with_transform:.4f},", end="")
print(f" reward {show(rows['reward'])}")
print(f"  keys under next: next reward {show(right['next', 'reward'])}, loss {mended:.4f}")
assert with_transform == before, "losses read the success now"
assert torch.equal(rows["next", "reward"], data["next", "reward"]) and not rows["reward"].any()
assert torch.equal(right["next", "reward"], ends.float()) and mended != before
PY
