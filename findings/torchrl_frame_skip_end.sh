#!/usr/bin/env bash
# torchrl 0.14.1: FrameSkipTransform and an episode that ends inside the repeated steps.
#
# Guess: the end of the episode ends the repetition, as with GymEnv(..., frame_skip=4): the reward up to
#        the end is returned, and done.
# Seen:  the environment is stepped on after its end, always to the full number, and these rewards are
#        added. MountainCarContinuous gives 100 once, at its goal: the return of the same policy is 89
#        with GymEnv's frame_skip of 4 or 8, and 389 or 788 with the transform. Only the done flag of the
#        last repeated step is kept. Where a flag is that of one state only, such as a goal that is passed,
#        the end is lost and the episode goes on. No warning. (FrameSkipTransform._step in
#        envs/transforms/_env.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, FrameSkipTransform, GymEnv, TransformedEnv


def swing(tensordict):
    """Full thrust in the direction of movement, which climbs the hill."""
    forwards = tensordict["observation"][..., 1:] >= 0
    return tensordict.set("action", torch.where(forwards, 1.0, -1.0))


class Corridor(EnvBase):
    """One metre a step. The goal is at metre 6, and the corridor goes on behind it."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded(1))
        self.action_spec = Unbounded(1)
        self.reward_spec = Unbounded(1)
        self.place = 0.0

    def _reset(self, tensordict=None):
        self.place = 0.0
        return TensorDict({"observation": torch.zeros(1)}, [])

    def _step(self, tensordict):
        self.place += 1
        here = {"observation": torch.tensor([self.place]), "reward": torch.zeros(1)}
        return TensorDict({**here, "done": torch.tensor([self.place == 6])}, [])

    def _set_seed(self, seed):
        pass


name = "MountainCarContinuous-v0"
print(f"torchrl {version('torchrl')}, {name}: return of one policy")
for skip in (4, 8):
    returns = []
    for env in (
        GymEnv(name, frame_skip=skip),
        TransformedEnv(GymEnv(name), FrameSkipTransform(skip)),
    ):
        env.set_seed(0)
        rows = env.rollout(999, swing)
        assert rows["next", "terminated"][-1] and len(rows) < 40
        returns.append(rows["next", "reward"].sum().item())
    print(f"  frame_skip={skip}: {returns[0]:.1f}, FrameSkipTransform({skip}): {returns[1]:.1f}")
    assert 80 < returns[0] < 100
    assert returns[1] > returns[0] + 200, "the repetition stops at the end now"

for skip in (1, 2, 3, 4, 5):
    rows = TransformedEnv(Corridor(), FrameSkipTransform(skip)).rollout(10)
    ends = rows["next", "done"].any().item()
    print(f"  a goal at step 6, FrameSkipTransform({skip}): ends at {len(rows) * skip if ends else 'no'} step")
    assert ends == (6 % skip == 0), "an end inside the repetition is kept now"
PY
