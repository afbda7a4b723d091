#!/usr/bin/env bash
# torchrl 0.14.1: the targets of DiscreteCQLLoss with delay_value=True, its default.
#
# Guess: the targets are r + γ max Q_target(s', a'), as in DQNLoss, and SoftUpdate moves Q_target.
# Seen:  the target network is never read. Filling its parameters with 100 changes DQNLoss's loss and leaves
#        that of DiscreteCQLLoss as it was, to the bit. Its targets come from the network that is trained, as
#        if there were no delay: tau and the updater have no effect, and nothing says so. (value_loss in
#        objectives/cql.py passes the parameters by a name that its value estimator does not take)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import OneHot
from torchrl.modules import QValueActor
from torchrl.objectives import DiscreteCQLLoss, DQNLoss

torch.manual_seed(0)
spec, no = OneHot(3), torch.zeros(64, 1, dtype=torch.bool)
after = {"observation": torch.randn(64, 4), "reward": torch.zeros(64, 1)}
after |= {"done": no, "terminated": no.clone()}
data = {"observation": torch.randn(64, 4), "action": spec.rand((64,)), "next": after}
data = TensorDict(data, [64])

print(f"torchrl {version('torchrl')}: the loss before and after a change of the target network")
changes = {}
for kind, key in ((DQNLoss, "loss"), (DiscreteCQLLoss, "loss_qvalue")):
    actor = QValueActor(nn.Linear(4, 3), in_keys=["observation"], spec=spec)
    loss = kind(actor, action_space=spec)
    loss.make_value_estimator(gamma=0.9)
    before = loss(data.clone())[key].item()
    targets = list(loss.target_value_network_params.values(True, True))
    assert len(targets) == 2, targets
    for each in targets:
        each.data.fill_(100.0)
    after = loss(data.clone())[key].item()
    changes[kind] = (before, after)
    print(f"  {kind.__name__}: {before:.6g}, {after:.6g}")
before, after = changes[DQNLoss]
assert after > 1000 * before, changes
before, after = changes[DiscreteCQLLoss]
assert after == before, changes
PY
