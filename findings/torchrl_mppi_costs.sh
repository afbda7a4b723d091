#!/usr/bin/env bash
# torchrl 0.14.1: MPPIPlanner with rewards that are costs, such as Pendulum's.
#
# Guess: the best plans get the largest weights. Weights of a softmax do not change if a constant is added
#        to all values.
# Seen:  weights are exp(value) without the largest one subtracted. Values below about -104 make all of
#        them 0, and the action is nan; values above 88 make it nan, too. A cost of 10 in each of 5 steps
#        works, in each of 25 it does not. No warning. (planning in modules/planners/mppi.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase
from torchrl.modules import MPPIPlanner, ValueOperator
from torchrl.objectives.value import TDLambdaEstimator


class Costs(nn.Module):
    def forward(self, observation, action):
        return observation, -10.0 - 0.1 * action.pow(2)


class Env(ModelBasedEnvBase):
    def __init__(self):
        super().__init__(TensorDictModule(Costs(), ["observation", "action"], ["observation", "reward"]))
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.state_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict({"observation": torch.zeros(1)}, [])


class Sum(nn.Module):
    """The return of each step."""

    def forward(self, data):
        return data.set("advantage", data["next", "reward"].flip(-2).cumsum(-2).flip(-2))


torch.manual_seed(0)
seen = {}
for horizon in (5, 25):
    planner = MPPIPlanner(Env(), Sum(), temperature=1.0, planning_horizon=horizon, optim_steps=2, num_candidates=16, top_k=4)
    action = planner(TensorDict({"observation": torch.zeros(1)}, []))["action"]
    seen[horizon] = bool(action.isfinite().all())
    print(f"torchrl {version('torchrl')}, cost 10 in each of {horizon} steps: action {action.tolist()}")
assert seen == {5: True, 25: False}, seen
PY
