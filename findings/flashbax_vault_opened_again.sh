#!/usr/bin/env bash
# flashbax 0.1.3: Vault, which stores a replay buffer's transitions on disk, opened again by a run that
# goes on.
#
# Guess: writing a buffer state whose transitions are all in the vault writes none, as in one process.
# Seen:  the vault keeps how many transitions it holds, but not up to where it has read the buffer. An
#        opened vault begins at the buffer's position 0, so a run that restores its buffer and goes on
#        writes what the buffer holds before its position again: all of it, or, if the buffer has wrapped
#        around, the newest part. The data set then holds these transitions twice. write() returns their
#        number without a warning.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet flashbax==0.1.3 jax==0.6.2 jaxlib==0.6.2 tensorstore==0.1.78 chex==0.1.90 numpy==2.2.6

FOLDER="$folder" JAX_PLATFORMS=cpu "$folder/venv/bin/python" -W ignore - <<'PY' | grep -v "^Loading vault\|^New vault\|^Since the"
import os
from importlib.metadata import version

import flashbax
import jax.numpy as jnp
from flashbax.vault import Vault

LENGTH = 10


def make():
    buffer = flashbax.make_trajectory_buffer(
        add_batch_size=1,
        sample_batch_size=1,
        sample_sequence_length=1,
        period=1,
        min_length_time_axis=1,
        max_length_time_axis=LENGTH,
    )
    return buffer, buffer.init({"step": jnp.zeros((), jnp.int32)})


def steps(first, last):
    return {"step": jnp.arange(first, last, dtype=jnp.int32)[None]}


def vault(name, state=None):
    structure = None if state is None else state.experience
    return Vault(name, structure, rel_dir=os.environ["FOLDER"], vault_uid="run")


def stored(name):
    return vault(name).read().experience["step"][0].tolist()


said = f"flashbax {version('flashbax')}"
for name, count in (("part", 6), ("wrapped", 13)):
    buffer, state = make()
    first = vault(name, state)
    for begin in range(0, count, 6):  # more often than the buffer's length, as the vault asks for
        state = buffer.add(state, steps(begin, min(begin + 6, count)))
        first.write(state)
    before = stored(name)
    again = first.write(state)
    opened = vault(name, state).write(state)
    print(f"{said}: stored {before}; written again: {again} by the same vault, {opened} by an opened one")
    print(f"  stored then: {stored(name)}")
    assert before == list(range(count)) and again == 0
    held = list(range(6)) if name == "part" else [10, 11, 12]
    assert stored(name) == before + held, "an opened vault goes on where it was now"
PY
