#!/usr/bin/env bash
# torchrl 0.14.1: BatchRenorm1d, the normalisation of CrossQ's critics, long after its warm-up.
#
# Guess: once warmup_steps batches have passed, a training batch is normalised by the running
#        statistics, within max_r and max_d, as the page says. It stays so for the rest of training.
# Seen:  the correction grows with every further warm-up length: it is doubled after 2 of them and
#        tenfold after 10. max_r and max_d do not bound it. With running statistics that let a batch
#        pass unchanged, a batch of mean 1 and deviation 2 leaves with mean 10 and deviation 11, and
#        one of deviation 0.5 leaves with its sign turned. Evaluation is right. No warning. The layer
#        cuts its counter off at warmup_steps with clamp_max, which returns a copy, not with clamp_max_.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from torchrl.modules import BatchRenorm1d

WARMUP = 10
torch.manual_seed(0)
unit = torch.randn(64, 1)
unit = (unit - unit.mean()) / unit.std(correction=0)
wide, narrow = 1 + 2 * unit, 0.5 * unit


def train(batches, capped=False):
    # Momentum 0 keeps the running statistics at mean 0 and variance 1: batches pass unchanged.
    layer = BatchRenorm1d(1, momentum=0.0, eps=0.0, warmup_steps=WARMUP).train()
    for _ in range(batches):
        layer(wide)
        if capped:
            layer.num_batches_tracked.clamp_(max=WARMUP)
    return layer


print(f"torchrl {version('torchrl')}: a batch of mean 1 and deviation 2, which should stay as it is")
seen = {}
for batches in (0, 10, 20, 100):
    out = train(batches)(wide)
    seen[batches] = round(out.mean().item(), 3), round(out.std(correction=0).item(), 3)
    print(f"  after {batches:3d} batches, warm-up {WARMUP}: mean, deviation {seen[batches]}")
assert seen[0] == (0.0, 1.0), "the warm-up is not batch normalisation"
assert seen[10] == (1.0, 2.0), "the end of the warm-up is not batch renormalisation"
assert seen[20] == (2.0, 3.0) and seen[100] == (10.0, 11.0), "the correction no longer grows"

slope = (train(100)(narrow) / narrow).mean().item()
print(f"  after 100 batches a batch of deviation 0.5 is multiplied by {slope:.1f}, not by 1")
assert slope < -7, "the sign no longer turns"

right = train(100, capped=True)(wide)
evaluated = train(100).eval()(wide)
assert torch.allclose(right, wide, atol=1e-5), "a capped counter does not mend it"
assert torch.allclose(evaluated, wide, atol=1e-5), "evaluation differs"


def gap(batches, capped):
    torch.manual_seed(1)
    layer = BatchRenorm1d(1, warmup_steps=100).train()
    for _ in range(batches):
        batch = 3 + 2 * torch.randn(32, 1)
        out = layer(batch)
        if capped:
            layer.num_batches_tracked.clamp_(max=100)
    return (out - layer.eval()(batch)).square().mean().sqrt().item()


wrong, mended = gap(5000, capped=False), gap(5000, capped=True)
print(f"steady data, warm-up 100, 5000 batches: training and evaluation differ by {wrong:.2f};")
print(f"  with the counter held at 100 they differ by {mended:.2f}")
assert wrong > 1 and mended < 0.1, "training and evaluation agree now"
PY
