#!/usr/bin/env bash
# skrl 2.1.1: Memory.load, which reads the file that save() or export=True has written.
#
# Guess: the memory then has the saved transitions, as many as were saved, and samples from them.
# Seen:  it samples from what it had before. load() puts the file's tensors into attributes that
#        sample() and sample_all() do not read. An empty memory stays empty: its length is 0, sample()
#        gives a batch of no rows, and sample_all() only NaN. A memory of other transitions, for example
#        of the last task, goes on sampling these. No warning, with .pt as with .npz.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 skrl==2.1.1 gymnasium==1.4.0 numpy==2.4.0

FOLDER="$folder" "$folder/venv/bin/python" -W ignore - <<'PY'
import os
from importlib.metadata import version
from pathlib import Path

import torch
from skrl.memories.torch import RandomMemory

ROWS = 8


def make(value=None):
    memory = RandomMemory(memory_size=ROWS, num_envs=1, device="cpu")
    memory.create_tensor(name="rewards", size=1, dtype=torch.float32)
    for _ in range(0 if value is None else ROWS):
        memory.add_samples(rewards=torch.tensor([[value]]))
    return memory


def sampled(memory):
    ((rewards,),) = memory.sample(["rewards"], batch_size=4)
    return rewards.flatten().tolist()


for kind in ("pt", "npz"):
    make(1.0).save(os.environ["FOLDER"], format=kind)
    (path,) = Path(os.environ["FOLDER"], "memories").glob(f"*.{kind}")
    empty, used = make(), make(-5.0)
    empty.load(str(path))
    used.load(str(path))
    everything = empty.sample_all(["rewards"])[0][0]
    print(f"skrl {version('skrl')}, .{kind}: rewards of 1 were saved; after loading,", end=" ")
    print(f"an empty memory has {len(empty)} rows and samples {sampled(empty)}, one of -5 samples {sampled(used)}")
    assert len(empty) == 0 and sampled(empty) == [], "the length is restored now"
    assert everything.isnan().all() and sampled(used) == [-5.0] * 4, "loaded rows are sampled now"
PY
