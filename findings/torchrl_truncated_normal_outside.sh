#!/usr/bin/env bash
# torchrl 0.14.1: the deterministic action of TruncatedNormal.
#
# Guess: the mean of a normal distribution that is truncated to [-1, 1] is between -1 and 1, whatever its
#        location: a policy that acts deterministically stays within its bounds.
# Seen:  if the location is more than some five scales beyond a bound, the mean is computed as the location
#        itself: with loc 1.5 and scale 0.05 the action is 1.5. Closer to the bound it is right. The default
#        of an actor in evaluation is this mean. No warning; the mode and the samples stay inside.
#        (modules/distributions/truncated_normal.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from torchrl.modules import TruncatedNormal

torch.manual_seed(0)
print(f"torchrl {version('torchrl')}: TruncatedNormal between -1 and 1, location 1.5")
found = {}
for scale in (0.5, 0.2, 0.1, 0.05, 0.02):
    distribution = TruncatedNormal(torch.tensor([[1.5]]), torch.tensor([[scale]]))
    action, sample = distribution.deterministic_sample.item(), distribution.rsample((1000,)).max().item()
    found[scale] = action
    print(f"  scale {scale}: deterministic {action:.4f}, mode {distribution.mode.item():.4f}, highest sample {sample:.4f}")
    assert distribution.mode.item() <= 1 and sample <= 1
assert all(found[scale] <= 1 for scale in (0.5, 0.2)), found
assert abs(found[0.05] - 1.5) < 1e-3 and abs(found[0.02] - 1.5) < 1e-3, found
PY
