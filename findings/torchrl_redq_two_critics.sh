#!/usr/bin/env bash
# torchrl 0.14.1: REDQLoss(num_qvalue_nets=2), sub_sample_len=2 by default.
#
# Guess: the target is the minimum of both critics, clipped double Q-learning, as REDQ is with N = M = 2.
# Seen:  the target is one critic, drawn at random in every update. sub_sample_len is lowered to
#        num_qvalue_nets - 1 without a word. (__init__ in objectives/redq.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import REDQLoss


class Constant(nn.Module):
    def __init__(self, value):
        super().__init__()
        self.value = nn.Parameter(torch.tensor(value))

    def forward(self, observation, action):
        return self.value + 0.0 * (observation.sum(-1, True) + action.sum(-1, True))


torch.manual_seed(0)
network = TensorDictModule(nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()), ["observation"], ["loc", "scale"])
actor = ProbabilisticActor(network, in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal, return_log_prob=True)
critics = [ValueOperator(Constant(value), in_keys=["observation", "action"]) for value in (0.0, 10.0)]
loss = REDQLoss(actor, critics, num_qvalue_nets=2, alpha_init=1e-6, min_alpha=1e-6, fixed_alpha=True, action_spec=None, target_entropy=-2.0)
loss.make_value_estimator(gamma=0.9)
flags = {name: torch.zeros(4, 1, dtype=torch.bool) for name in ("done", "terminated")}
following = TensorDict({"observation": torch.randn(4, 3), "reward": torch.zeros(4, 1), **flags}, [4])
batch = TensorDict({"observation": torch.randn(4, 3), "action": torch.zeros(4, 2), "next": following}, [4])
targets = [round(loss(batch)["target_value"].mean().item(), 2) for _ in range(50)]
print(f"torchrl {version('torchrl')}: critics say 0 and 10, gamma 0.9; targets in 50 calls {sorted(set(targets))};")
print(f"  sub_sample_len {loss.sub_sample_len}; the minimum would be 0")
assert loss.sub_sample_len == 1, loss.sub_sample_len
assert set(targets) == {0.0, 9.0}, set(targets)
PY
