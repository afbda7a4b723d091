#!/usr/bin/env bash
# ema-pytorch 0.8.3: KarrasEMA(update_every=100), which saves time.
#
# Guess: nearly the average of update_every=1: the weight of a step follows from its number.
# Seen:  each update counts as one step, although 100 have passed: the average forgets a hundred times as
#        slowly. After one update at weight 0 and 10,000 calls at weight 1 the average is far from 1. No
#        warning. (post_hoc_ema.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==2.4.6 ema-pytorch==0.8.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from ema_pytorch.post_hoc_ema import KarrasEMA

found = {}
for every in (1, 100):
    network = torch.nn.Linear(1, 1, bias=False)
    network.weight.data.zero_()
    average = KarrasEMA(network, sigma_rel=0.1, update_every=every)
    average.update()
    network.weight.data.fill_(1.0)
    for _ in range(10_000):
        average.update()
    found[every] = average.ema_model.weight.item()
    print(f"ema-pytorch {version('ema-pytorch')}, update_every={every}: average {found[every]:.3f} after 10,000 steps at 1")
assert found[1] > 0.99 and found[100] < 0.9, found
PY
