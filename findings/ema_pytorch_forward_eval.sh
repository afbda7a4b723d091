#!/usr/bin/env bash
# ema-pytorch 0.8.3: EMA.forward_eval(x).
#
# Guess: evaluation mode, as the name and the comment say: two calls agree.
# Seen:  gradients are off, but the averaged network stays in training mode: dropout draws, and
#        normalisations learn from the data that are evaluated. ema.ema_model.eval() before the call works.
#        (ema_pytorch.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==2.4.6 ema-pytorch==0.8.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from ema_pytorch import EMA
from torch import nn

torch.manual_seed(0)
average = EMA(nn.Sequential(nn.Linear(8, 8), nn.Dropout(0.5)))
data, seen = torch.ones(4, 8), {}
for name in ("as it is", "after ema_model.eval()"):
    first, second = average.forward_eval(data), average.forward_eval(data)
    seen[name] = torch.equal(first, second)
    print(f"ema-pytorch {version('ema-pytorch')}, {name}: two calls agree: {seen[name]}")
    average.ema_model.eval()
assert list(seen.values()) == [False, True], seen
PY
