#!/usr/bin/env bash
# torchrl 0.14.1: CQLLoss(with_lagrange=True), whose multiplier α' should scale the penalty.
#
# Guess: as published (Kumar et al. 2020), the critics' penalty is multiplied by α', which grows while the
#        penalty exceeds the threshold.
# Seen:  the penalty is not multiplied. α' has a loss of its own, "loss_alpha_prime", through which its
#        gradient reaches the critics with the opposite sign: with the sum of the losses, which one trains,
#        the critics get (1 - α'/2) times the gradient of the penalty. It is half at α' = 1, nothing at 2, and
#        above that critics are pushed to the high values that the penalty should prevent, the more the higher
#        they are. No warning. (alpha_prime_loss in objectives/cql.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import CQLLoss

torch.manual_seed(0)
actor = ProbabilisticActor(
    TensorDictSequential(
        TensorDictModule(nn.Linear(4, 4), ["observation"], ["parameters"]),
        TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"]),
    ),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)

class Joined(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(6, 32), nn.Tanh(), nn.Linear(32, 1))

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action], -1))


critic = ValueOperator(Joined(), in_keys=["observation", "action"])
no = torch.zeros(64, 1, dtype=torch.bool)
after = {"observation": torch.randn(64, 4), "reward": torch.zeros(64, 1)}
after |= {"done": no, "terminated": no.clone()}
data = {"observation": torch.randn(64, 4), "action": torch.rand(64, 2) * 2 - 1, "next": after}
data = TensorDict(data, [64])
spec = Bounded(-1, 1, (2,))
loss = CQLLoss(actor, critic, action_spec=spec, with_lagrange=True, lagrange_thresh=0.0)
loss.make_value_estimator(gamma=0.9)
parameters = [p for p in loss.qvalue_network_params.values(True, True) if p.requires_grad]
assert parameters

print(f"torchrl {version('torchrl')}: gradient of the critics, of all penalties over that of loss_cql")
for multiplier in (0.5, 1.0, 2.0, 4.0, 10.0):
    loss.log_alpha_prime.data.fill_(multiplier).log_()
    losses = loss(data.clone())
    penalty = torch.autograd.grad(losses["loss_cql"], parameters, retain_graph=True)
    both = torch.autograd.grad(losses["loss_cql"] + losses["loss_alpha_prime"], parameters)
    penalty, both = (torch.cat([each.flatten() for each in g]) for g in (penalty, both))
    ratio = (both @ penalty / (penalty @ penalty)).item()
    print(f"  multiplier {multiplier}: {ratio:.3f}; by definition {multiplier}")
    assert torch.allclose(both, (1 - multiplier / 2) * penalty, atol=1e-4), ratio
    assert abs(ratio - (1 - multiplier / 2)) < 1e-3, ratio
PY
