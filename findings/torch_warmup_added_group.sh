#!/usr/bin/env bash
# torch 2.13.0: a learning rate warm-up with LinearLR, and parameters that the optimizer gets later.
#
# Guess: a layer that is unfrozen during the warm-up is added with its learning rate, and trained with
#        this rate at most: LinearLR's factor grows from start_factor to 1. Or it is an error, as with
#        LambdaLR and OneCycleLR.
# Seen:  each step multiplies what the rate is by the growth of the factor. The new group did not start at
#        start_factor times its rate, but is multiplied all the same. Added right after the scheduler
#        was made with start_factor=0.01, it ends at 100 times its rate; added half way at twice.
#        Together with a decay in ChainedScheduler it is the same. No warning. StepLR, ExponentialLR and
#        CosineAnnealingLR multiply, too, but start at the full rate. SequentialLR raises an error once
#        its warm-up ends.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0

"$folder/venv/bin/python" -W ignore - <<'PY'
import torch
from torch import nn
from torch.optim.lr_scheduler import ChainedScheduler, CosineAnnealingLR, LambdaLR, LinearLR

WARMUP, RATE = 100, 1e-3


def highest_rates(added_at, make):
    """The highest learning rate of a group that is there at first and of one that is added."""
    optimizer = torch.optim.Adam(nn.Linear(1, 1).parameters(), lr=RATE)
    scheduler = make(optimizer)
    rates = ([], [])
    for step in range(2 * WARMUP):
        if step == added_at:
            optimizer.add_param_group({"params": nn.Linear(1, 1).parameters(), "lr": RATE})
        optimizer.step()
        scheduler.step()
        for group, seen in zip(optimizer.param_groups, rates):
            seen.append(group["lr"])
    return tuple(round(max(seen) / RATE, 2) for seen in rates)


def warmup(optimizer):
    return LinearLR(optimizer, start_factor=0.01, total_iters=WARMUP)


def warmup_and_cosine(optimizer):
    return ChainedScheduler([warmup(optimizer), CosineAnnealingLR(optimizer, T_max=20 * WARMUP)])


seen = {}
for make in (warmup, warmup_and_cosine):
    for step in (0, WARMUP // 2, WARMUP):
        seen[make.__name__, step] = highest_rates(step, make)
        first, added = seen[make.__name__, step]
        print(f"torch {torch.__version__}, {make.__name__}: group added at step {step} of {WARMUP}:", end="")
        print(f" at most {added} times its rate, the first group {first}")
assert seen["warmup", 0] == (1.0, 100.0), "a group that is added at the start ends at its rate now"
assert seen["warmup_and_cosine", 0][1] > 90
assert 1.9 < seen["warmup", WARMUP // 2][1] < 2.1 and seen["warmup", WARMUP] == (1.0, 1.0)
try:
    highest_rates(0, lambda optimizer: LambdaLR(optimizer, lambda step: min(1.0, 0.01 + step / WARMUP)))
except ValueError as error:
    print(f"LambdaLR: ValueError: {error}")
else:
    raise AssertionError("LambdaLR accepts a group that is added now")
PY
