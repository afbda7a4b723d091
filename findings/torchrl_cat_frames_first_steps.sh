#!/usr/bin/env bash
# torchrl 0.14.1: CatFrames.make_rb_transform_and_sampler, which stacks frames when a buffer is sampled.
#
# Guess: the buffer gives the stacks that the policy has seen, without storing them: those of all steps,
#        the first ones filled up with the first frame, as in the environment.
# Seen:  with N frames a stack, the first N - 1 steps of each episode are never sampled, and episodes
#        shorter than N not at all. The sampler draws slices of N steps that lie in an episode, and only the
#        last step of each is kept. A value or a policy of the states in which every episode begins is
#        never trained. Of episodes with 10, 3 and 7 steps and N = 4, 11 of 20 steps are ever sampled; in
#        these, the stacks are right. No warning. strict_length=False, which would allow shorter slices, ends
#        in an error. (make_rb_transform_and_sampler in envs/transforms/_observation.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0 \
    numpy==2.2.6

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import CatFrames, Compose, GymWrapper, RenameTransform, TransformedEnv

N, LENGTHS = 4, (10, 3, 7)


class Count(gymnasium.Env):
    """Shows the number of the episode and of the step: 203 is step 3 of episode 2."""

    observation_space = gymnasium.spaces.Box(0, 1000, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    episode = -1

    def show(self):
        return np.array([100 * self.episode + self.steps], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode += 1
        self.steps = 0
        return self.show(), {}

    def step(self, action):
        self.steps += 1
        return self.show(), 0.0, self.steps == LENGTHS[self.episode % len(LENGTHS)], False, {}


torch.manual_seed(0)
stack = CatFrames(N=N, dim=-1, in_keys=["frames"])
rename = RenameTransform(["observation"], ["frames"], create_copy=True)
# Making the specifications resets the environment too, so that the first episode is numbered anew.
gym = Count()
environment = TransformedEnv(GymWrapper(gym), Compose(rename, stack))
transform, sampler = stack.make_rb_transform_and_sampler(batch_size=64, end_key=("next", "done"))
buffer = ReplayBuffer(
    storage=LazyTensorStorage(100),
    sampler=sampler,
    batch_size=64,
    transform=Compose(
        RenameTransform(
            ["observation", ("next", "observation")], ["frames", ("next", "frames")], create_copy=True
        ),
        transform,
    ),
)
gym.episode = -1
data = environment.rollout(sum(LENGTHS), break_when_any_done=False)
seen = {int(row[-1]): row.tolist() for row in data["frames"]}
buffer.extend(data)
drawn = {}
for _ in range(200):
    batch = buffer.sample()
    drawn |= {int(o): f.tolist() for o, f in zip(batch["observation"][:, 0], batch["frames"])}

print(f"torchrl {version('torchrl')}: stacks of {N}, episodes of {', '.join(map(str, LENGTHS))} steps")
for episode, length in enumerate(LENGTHS):
    steps = [i % 100 for i in sorted(drawn) if i // 100 == episode]
    print(f"  steps 0 to {length - 1}, sampled from the buffer: {steps}")
    assert steps == list(range(N - 1, length)), "the first steps are sampled now"
print(f"  of {len(seen)} stacks that the environment gave, {len(drawn)} are ever sampled from the buffer")
assert len(seen) == sum(LENGTHS) and all(seen[i] == drawn[i] for i in drawn)
PY
