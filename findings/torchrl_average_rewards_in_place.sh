#!/usr/bin/env bash
# torchrl 0.14.1: TDLambdaEstimator(average_rewards=True), also TD0 and TD1.
#
# Guess: rewards are standardised for the targets alone, 'before the TD is computed'.
# Seen:  the rewards of the batch that was passed in are replaced by the standardised ones. Whoever reads
#        the batch afterwards, to log the return or to fill a buffer, gets numbers of mean 0. A second
#        call, as for a second epoch, standardises again. (objectives/value/advantages.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.modules import ValueOperator
from torchrl.objectives.value import TDLambdaEstimator

value = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
flags = {name: torch.zeros(1, 10, 1, dtype=torch.bool) for name in ("done", "terminated")}
reward = torch.ones(1, 10, 1)
reward[0, 0] = 11.0
following = TensorDict({"observation": torch.randn(1, 10, 3), "reward": reward, **flags}, [1, 10])
batch = TensorDict({"observation": torch.randn(1, 10, 3), "next": following}, [1, 10])
before = batch["next", "reward"].sum().item()
TDLambdaEstimator(gamma=0.9, lmbda=0.9, value_network=value, average_rewards=True)(batch)
after = batch["next", "reward"].sum().item()
print(f"torchrl {version('torchrl')}: return of the batch {before:.1f} before, {after:.1f} after")
assert before == 20 and abs(after) < 1e-4, (before, after)
PY
