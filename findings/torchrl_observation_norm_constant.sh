#!/usr/bin/env bash
# torchrl 0.14.1: ObservationNorm with the mean and deviation of data, one part of which is constant.
#
# Guess: with standard_normal=True, eps (1e-6 by default) is added to the scale, as the page says. A
#        part that never changes becomes 0.
# Seen:  eps is used for a scale that is one Python number, or that init_stats() computes, not for a
#        tensor. The page's own example, loc=data.mean(0), scale=data.std(0), gives NaN for a constant
#        part, with eps passed as well. No warning.
#
# Here: the statistics of data sets have scale 1 for a constant part (functional.mean_and_scale).
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.envs.transforms import ObservationNorm

data = torch.tensor([[1.0, 5.0], [2.0, 5.0], [3.0, 5.0]])  # the second part is constant


def normalise(loc, scale, values, **options):
    norm = ObservationNorm(loc, scale, in_keys=["x"], standard_normal=True, **options)
    return norm(TensorDict({"x": values}, [len(values)]))["x"]


loc, scale = data.mean(0), data.std(0)
default, larger = normalise(loc, scale, data), normalise(loc, scale, data, eps=0.1)
number = normalise(5.0, 0.0, data[:, 1:])
clamped = normalise(loc, scale.clamp_min(1e-6), data)
print(f"torchrl {version('torchrl')}: scale {scale.tolist()}, first row {default[0].tolist()},")
print(f"  with eps=0.1 {larger[0].tolist()}, with the scale as a number {number[0].tolist()},")
print(f"  with the tensor clamped before {clamped[0].tolist()}")
for seen in (default, larger):
    assert seen[:, 0].tolist() == [-1.0, 0.0, 1.0]
    assert seen[:, 1].isnan().all(), "a constant part is finite now"
assert (number == 0).all() and (clamped[:, 1] == 0).all()
PY
