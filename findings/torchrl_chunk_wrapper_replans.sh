#!/usr/bin/env bash
# torchrl 0.14.1: MultiStepActorWrapper asks a policy for a chunk of actions and plays it step by step.
#
# Guess: without n_steps the wrapper takes the length from the chunk itself, and asks the policy again
#        once the chunk is used up. The page of replan_interval says so for its default.
# Seen:  the policy is asked only when an episode begins. Then its first chunk is played over and over
#        until the episode ends, whatever is observed. No warning. With n_steps given, or with
#        replan_interval, it is asked again after each chunk.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.modules import MultiStepActorWrapper


class Clock(EnvBase):
    """Two environments that observe the number of the step."""

    def __init__(self):
        super().__init__(batch_size=[2])
        self.observation_spec = Composite(observation=Unbounded((2, 1)), shape=[2])
        self.action_spec = Unbounded((2, 1))
        self.reward_spec = Unbounded((2, 1))
        self.done_spec = Binary(1, (2, 1), dtype=torch.bool)

    def _reset(self, tensordict):
        return TensorDict({"observation": torch.zeros(2, 1)}, [2])

    def _step(self, tensordict):
        after = {"observation": tensordict["observation"] + 1, "reward": torch.zeros(2, 1)}
        return TensorDict({**after, "done": torch.zeros(2, 1, dtype=torch.bool)}, [2])

    def _set_seed(self, seed):
        pass


def policy(observation):
    """The actions for this step and the next one are their numbers."""
    return torch.stack([observation, observation + 1], -2)


env = TransformedEnv(Clock(), InitTracker())
seen = {}
for options in ({}, {"n_steps": 2}, {"replan_interval": 2}):
    actor = TensorDictModule(policy, ["observation"], ["action"])
    data = env.rollout(6, MultiStepActorWrapper(actor, **options))
    assert data["observation"][0].flatten().tolist() == [0, 1, 2, 3, 4, 5]
    seen[str(options)] = data["action"][0].flatten().tolist()
    print(f"torchrl {version('torchrl')}, options {options}: actions {seen[str(options)]}")
first, *others = seen.values()
assert first == [0, 1, 0, 1, 0, 1], "the chunk is not repeated any more"
assert all(actions == [0, 1, 2, 3, 4, 5] for actions in others), "given lengths have changed"
PY
