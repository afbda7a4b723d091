#!/usr/bin/env bash
# torchrl 0.14.1: HERReplayBuffer with a transform that scales observations and goals.
#
# Guess: reward_fn gets a row whose goal and achieved goal are in the same units, whether before or
#        after the transform, and what sample() gives is normalised throughout.
# Seen:  the row is transformed first. Then its goal is replaced by a stored one, which is not. With
#        goals divided by 100, reward_fn compares an achieved goal of 0.03 with a desired one of 3. No
#        relabelled row is rewarded, though each goal was reached, and the goals in the batch are a
#        hundred times too large. No warning. Scaled before they are stored, goals match and every
#        row is rewarded.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import HERReplayBuffer, LazyTensorStorage
from torchrl.envs.transforms import ObservationNorm

KEYS = ["achieved_goal", "desired_goal", ("next", "achieved_goal"), ("next", "desired_goal")]
standing = torch.full((8, 1), 3.0)  # a robot that stands at 3 and has reached whatever it achieved
other = torch.full((8, 1), 7.0)
following = {
    "achieved_goal": standing,
    "desired_goal": other,
    "reward": torch.zeros(8, 1),
    "done": (torch.arange(8) % 4 == 3)[:, None],
}
rows = TensorDict({"achieved_goal": standing, "desired_goal": other, "next": following}, [8])


def scaling():
    scale = torch.tensor(0.01)
    return ObservationNorm(loc=torch.zeros(()), scale=scale, in_keys=KEYS, out_keys=KEYS)


def reached(transition):
    distance = (transition["next", "achieved_goal"] - transition["desired_goal"]).abs()
    return (distance < 1e-4).float()


def batch(rows, transform=None):
    buffer = HERReplayBuffer(
        reached, storage=LazyTensorStorage(8), her_ratio=1.0, strategy="future", transform=transform
    )
    buffer.extend(rows)
    return buffer.sample(64)


wrong = batch(rows.clone(), scaling())
right = batch(scaling()(rows.clone()))
for name, seen in (("in the buffer", wrong), ("before storing", right)):
    achieved, goal = seen["achieved_goal"].mean().item(), seen["desired_goal"].mean().item()
    reward = seen["next", "reward"].mean().item()
    print(f"torchrl {version('torchrl')}, scaled {name}: achieved {achieved:.2f}, goal {goal:.2f},", end="")
    print(f" mean reward {reward:.0f}")
assert torch.allclose(wrong["achieved_goal"], torch.tensor(0.03))
assert torch.allclose(wrong["desired_goal"], torch.tensor(3.0)), "goals are transformed now"
assert wrong["next", "reward"].sum() == 0, "relabelled rows are rewarded now"
assert torch.allclose(right["desired_goal"], torch.tensor(0.03))
assert right["next", "reward"].all()
PY
