#!/usr/bin/env bash
# torchrl 0.14.1: VideoRecorder of pictures in [0, 1], as ToTensorImage makes them.
#
# Guess: they are scaled to 0..255, or refused.
# Seen:  they are cast to whole numbers, so all that is below 1.0 becomes 0: a black video, without a
#        warning. (_apply_transform in record/recorder.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.record import VideoRecorder

found = {}
for name, picture in {
    "float32 0.9": torch.full((3, 8, 8), 0.9),
    "uint8 230": torch.full((3, 8, 8), 230, dtype=torch.uint8),
}.items():
    recorder = VideoRecorder(None, "x", skip=1)
    recorder(TensorDict({"pixels": picture}, []))
    found[name] = recorder.obs[0].max().item()
    print(f"torchrl {version('torchrl')}, {name}: recorded as {found[name]}")
assert list(found.values()) == [0, 230], found
PY
