#!/usr/bin/env bash
# skrl 2.1.1: filling a memory with recorded transitions, several rows a call.
#
# Guess: the page of add_samples allows it with num_envs=1 ("store multiple samples"). Each row has its
#        observation, action and reward, as in a call with one row.
# Seen:  each tensor is stored after the one before: the position moves on once a tensor, not once a
#        call. With four calls of three rows into a memory of twelve, all numbers are there, and the
#        memory says that it is full, but no observation lies beside its action. No warning. One row a
#        call is right, and so is one call that fills the memory exactly.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 skrl==2.1.1 gymnasium==1.4.0 numpy==2.4.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from skrl.memories.torch import RandomMemory

ROWS, NAMES = 12, ("observations", "actions", "rewards")


def fill(rows_a_call):
    """Every row has its number in all three tensors."""
    memory = RandomMemory(memory_size=ROWS, num_envs=1, device="cpu")
    for name in NAMES:
        memory.create_tensor(name=name, size=1, dtype=torch.float32)
    for rows in torch.arange(ROWS, dtype=torch.float32)[:, None].split(rows_a_call):
        memory.add_samples(**{name: rows.clone() for name in NAMES})
    (batch,) = memory.sample(list(NAMES), batch_size=ROWS)
    together = sum(len(set(row)) == 1 for row in torch.cat(batch, dim=1).tolist())
    return len(memory), sorted(batch[0].flatten().int().tolist()), together


for rows_a_call in (1, 3, 12):
    length, numbers, together = fill(rows_a_call)
    print(f"skrl {version('skrl')}, {rows_a_call} rows a call: {length} rows, of which {together}", end=" ")
    print("have observation, action and reward of the same step")
    assert length == ROWS and numbers == list(range(ROWS)), "other rows now"
    assert together == (0 if rows_a_call == 3 else ROWS), "rows stay together now"
PY
