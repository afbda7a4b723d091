#!/usr/bin/env bash
# torchrl 0.14.1: tanh_loc=True, which bounds the location of a policy's distribution.
#
# Guess: as the pages say, loc = tanh(loc / upscale) * upscale.
# Seen:  IndependentNormal ignores it: a location of 10 stays 10 instead of 4.8. TanhNormal adds the middle of
#        its bounds to the bounded location before the tanh: between 0 and 10 the location 0 gives the action
#        9.9995 instead of 5, and no location gives less than 5. Without tanh_loc both are right. No warning.
#        (modules/distributions/continuous.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.modules import IndependentNormal, TanhNormal

one = torch.ones(1)
normal = IndependentNormal(10 * one, one, tanh_loc=True, upscale=5.0)
expected = 5 * torch.tanh(torch.tensor(2.0)).item()
print(f"torchrl {version('torchrl')}: IndependentNormal, location 10: {normal.mean.item():.3f}; expected {expected:.3f}")
print("TanhNormal between 0 and 10, deterministic action without and with tanh_loc:")
found = {}
for location in (-100.0, -1.0, 0.0, 1.0):
    found[location] = [
        TanhNormal(location * one, one, low=0.0, high=10.0, tanh_loc=given).deterministic_sample.item()
        for given in (False, True)
    ]
    print(f"  location {location:.0f}: {found[location][0]:.4f}, {found[location][1]:.4f}")
assert normal.mean.item() == 10.0
assert abs(found[0.0][0] - 5) < 1e-3 and found[0.0][1] > 9.99, found
assert found[-100.0][0] < 0.1 and found[-100.0][1] >= 4.99, found
PY
