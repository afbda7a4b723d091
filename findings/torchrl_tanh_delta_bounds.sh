#!/usr/bin/env bash
# torchrl 0.14.1: TanhDelta between bounds that are not symmetric, say 0 and 1.
#
# Guess: an output x of the network becomes low + (high - low) (tanh(x) + 1) / 2, as TanhModule gives: the
#        middle of the range for x = 0.
# Seen:  the middle of the range is added to x before the tanh, and once more after it. In [0, 10] the output
#        0 becomes 9.9995 instead of 5, and its gradient is 0.0009 instead of 5. In [0, 1], the range of a
#        gripper or a throttle, it becomes 0.73. Symmetric bounds are right. It is the distribution that the
#        page of DecisionTransformerInferenceWrapper uses. (TanhDelta.update in
#        modules/distributions/continuous.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.modules import TanhDelta, TanhModule

print(f"torchrl {version('torchrl')}: the action for x = 0, and its gradient")
found = {}
for low, high in ((-2.0, 2.0), (0.0, 1.0), (0.0, 10.0)):
    x = torch.zeros(1, 1, requires_grad=True)
    action = TanhDelta(x, low=low, high=high).mode
    (gradient,) = torch.autograd.grad(action.sum(), x)
    y = torch.zeros(1, 1, requires_grad=True)
    module = TanhModule(in_keys=["action"], spec=Bounded(low, high, (1,)))
    expected = module(TensorDict({"action": y}, [1]))["action"]
    (slope,) = torch.autograd.grad(expected.sum(), y)
    found[low, high] = (action.item(), gradient.item())
    print(
        f"  [{low:.0f}, {high:.0f}]: TanhDelta {action.item():.4f}, {gradient.item():.4f};"
        f" TanhModule {expected.item():.4f}, {slope.item():.4f}"
    )
    assert abs(expected.item() - (low + high) / 2) < 1e-5
    assert abs(slope.item() - (high - low) / 2) < 1e-3
assert abs(found[-2.0, 2.0][0]) < 1e-5, found
assert abs(found[0.0, 1.0][0] - 0.7311) < 1e-3, found
assert found[0.0, 10.0][0] > 9.999 and found[0.0, 10.0][1] < 0.01, found
PY
