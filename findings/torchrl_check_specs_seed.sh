#!/usr/bin/env bash
# torchrl 0.14.1: check_env_specs(env, seed=0, break_when_any_done=False).
#
# Guess: the check of check_env_specs(env, break_when_any_done=False), with a seed.
# Seen:  with a seed the function calls itself without break_when_any_done, so only the first episode is
#        checked. An environment whose second reset returns another dtype passes with a seed, and fails
#        without. (envs/utils.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs


class Odd(EnvBase):
    """Every episode has one step; a reset after a step returns float64."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))
        self.stepped = False

    def _reset(self, tensordict=None, **kwargs):
        dtype = torch.float64 if self.stepped else torch.float32
        self.stepped = False
        return TensorDict({"observation": torch.zeros(1, dtype=dtype)}, [])

    def _step(self, tensordict):
        self.stepped = True
        return TensorDict({"observation": torch.zeros(1), "reward": torch.zeros(1), "done": torch.ones(1, dtype=torch.bool)}, [])

    def _set_seed(self, seed):
        self.stepped = False


seen = {}
for seed in (None, 0):
    try:
        check_env_specs(Odd(), seed=seed, break_when_any_done=False)
        seen[seed] = "passes"
    except Exception as error:
        seen[seed] = type(error).__name__
    print(f"torchrl {version('torchrl')}, seed={seed}: {seen[seed]}")
assert seen[None] != "passes" and seen[0] == "passes", seen
PY
