#!/usr/bin/env bash
# torchrl 0.14.1: weights of prioritised replay in the losses of offline algorithms.
#
# Guess: every loss that writes td_error for a prioritised buffer also multiplies the rows by its
#        priority_weight, as DDPG, SAC, TD3 and TD3+BC do. Each has use_prioritized_weights='auto'.
# Seen:  IQLLoss, DiscreteIQLLoss, CQLLoss, DiscreteCQLLoss, REDQLoss and CrossQLoss never read the
#        weights, so the bias of the sampling is never corrected. No warning.
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
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import IQLLoss, TD3BCLoss

torch.manual_seed(0)
flags = {name: torch.zeros(4, 1, dtype=torch.bool) for name in ("done", "terminated")}
following = TensorDict({"observation": torch.randn(4, 3), "reward": torch.randn(4, 1), **flags}, [4])
batch = TensorDict({"observation": torch.randn(4, 3), "action": torch.rand(4, 2) - 0.5, "next": following}, [4])
network = TensorDictModule(nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()), ["observation"], ["loc", "scale"])
gaussian = ProbabilisticActor(network, in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal)
critics = [ValueOperator(MLP(in_features=5, out_features=1, num_cells=[8]), in_keys=["observation", "action"]) for _ in range(2)]
value = ValueOperator(MLP(in_features=3, out_features=1, num_cells=[8]), in_keys=["observation"])
plain = TensorDictModule(nn.Linear(3, 2), ["observation"], ["action"])
losses = {
    "IQLLoss": IQLLoss(gaussian, critics, value),
    "TD3BCLoss": TD3BCLoss(plain, critics, bounds=(-1.0, 1.0)),
}
seen = {}
for name, loss in losses.items():
    values = []
    for weight in (None, torch.tensor([1.0, 0.0, 0.0, 0.0])):
        given = batch.clone()
        if weight is not None:
            given["priority_weight"] = weight
        torch.manual_seed(1)
        values.append(loss(given)["loss_qvalue"].item())
    seen[name] = values[0] == values[1]
    print(f"torchrl {version('torchrl')}, {name}: {values[0]:.6f} without weights, {values[1]:.6f} with [1, 0, 0, 0]")
assert seen == {"IQLLoss": True, "TD3BCLoss": False}, seen
PY
