#!/usr/bin/env bash
# torchrl 0.14.1: BCLoss for a Gaussian policy whose parameters have names of their own.
#
# Guess: as its page says, it "minimizes the negative log-likelihood" and "works with any actor network that
#        implements get_dist".
# Seen:  the likelihood is used only if the policy's output contains top-level keys named "loc" and "scale".
#        With "mu" and "sigma", or keys in a nested TensorDict, the loss is the squared error of the mean
#        instead. The scale gets no gradient and keeps its first value. No warning. (BCLoss.forward in
#        objectives/bc.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import BCLoss


def loss_of(mean, deviation):
    """Loss of N(0, 1) for actions of 1, and whether the deviation gets a gradient."""
    linear = nn.Linear(1, 2)
    nn.init.zeros_(linear.weight)
    nn.init.zeros_(linear.bias)
    module = TensorDictModule(nn.Sequential(linear, NormalParamExtractor()), ["observation"], [mean, deviation])
    actor = ProbabilisticActor(
        module,
        in_keys={"loc": mean, "scale": deviation},
        out_keys=["action"],
        distribution_class=IndependentNormal,
    )
    data = TensorDict({"observation": torch.zeros(4, 1), "action": torch.full((4, 1), 1.5)}, [4])
    loss = BCLoss(actor)
    value = loss(data)["loss_bc"]
    value.backward()
    (bias,) = [p for name, p in loss.named_parameters() if name.endswith("bias")]
    return value.item(), bias.grad[1].item()


print(f"torchrl {version('torchrl')}: loss of N(0, 1) for the action 1.5, and its gradient by the scale")
found = {}
for names in (("loc", "scale"), ("mu", "sigma")):
    found[names[0]] = loss_of(*names)
    print(f"  {names[0]}, {names[1]}: {found[names[0]][0]:.4f}, {found[names[0]][1]:.3f}")
likelihood = 0.5 * 1.5**2 + 0.9189
print(f"  negative log-likelihood {likelihood:.4f}, squared error {1.5**2:.4f}")
assert abs(found["loc"][0] - likelihood) < 1e-3 and found["loc"][1] != 0, found
assert abs(found["mu"][0] - 2.25) < 1e-3 and found["mu"][1] == 0, found
PY
