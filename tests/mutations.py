"""Mutations of files, and the process of its own in which they are tried.

HDF5 may crash or loop for ever on a mutated file, so the outcomes are written line by line.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Outcome = dict[str, Any]
Random = np.random.Generator
LINK = h5py.SoftLink("/nowhere")


def flip(data: bytearray, rng: Random) -> None:
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))


def flip_text_or_number(data: bytearray, rng: Random) -> None:
    # Much of a file is zeros, which nothing reads.
    used = np.flatnonzero(np.frombuffer(bytes(data), np.uint8))
    data[rng.choice(used)] ^= 1 << int(rng.integers(8))


def truncate(data: bytearray, rng: Random) -> None:
    del data[rng.integers(len(data)) :]


def append(data: bytearray, rng: Random) -> None:
    data += rng.bytes(int(rng.integers(1, 5000)))


def block(data: bytearray, rng: Random) -> slice:
    """A random block of up to 4096 bytes."""
    size = int(rng.choice([1, 2, 8, 64, 512, 4096]))
    start = int(rng.integers(len(data) - size))
    return slice(start, start + size)


def zero(data: bytearray, rng: Random) -> None:
    here = block(data, rng)
    data[here] = bytes(here.stop - here.start)


def fill(data: bytearray, rng: Random) -> None:
    here = block(data, rng)
    data[here] = b"\xff" * (here.stop - here.start)


def overwrite(data: bytearray, rng: Random) -> None:
    here = block(data, rng)
    data[here] = rng.bytes(here.stop - here.start)


def copy_elsewhere(data: bytearray, rng: Random) -> None:
    here = block(data, rng)
    start = int(rng.integers(len(data) - (here.stop - here.start)))
    data[start : start + here.stop - here.start] = data[here]


def duplicate(data: bytearray, rng: Random) -> None:
    here = block(data, rng)
    data[here.stop : here.stop] = data[here]


def drop(data: bytearray, rng: Random) -> None:
    del data[block(data, rng)]


BYTES: dict[str, tuple[Callable[[bytearray, Random], None], int]] = {
    "flipped bit": (flip, 25),
    "flipped bit in use": (flip_text_or_number, 50),
    "truncated": (truncate, 10),
    "bytes appended": (append, 3),
    "block of zeros": (zero, 12),
    "block of ones": (fill, 12),
    "random block": (overwrite, 12),
    "block copied elsewhere": (copy_elsewhere, 12),
    "block duplicated": (duplicate, 7),
    "block removed": (drop, 7),
}
"""Mutations of bytes, and how often each is tried."""


def as_text(array: np.ndarray) -> np.ndarray:
    """The numbers as text of any length."""
    return array.astype(str).astype(h5py.string_dtype())


def as_pairs(array: np.ndarray) -> np.ndarray:
    """A table of two columns, which is no array of numbers."""
    return np.zeros(len(array), dtype=[("a", float), ("b", np.int8)])


def try_all(mutator: Any, mutations: Iterable[tuple[str, str, int]], folder: Path) -> None:
    """Tries mutations and writes each into a file first: the last one may end the process."""
    os.fsync = lambda descriptor: None  # a power cut is not among the mutations
    with open(folder / "outcomes.jsonl", "w") as file:
        for mutation in mutations:
            file.write(json.dumps({"mutation": mutation}) + "\n")
            file.flush()
            form, kind, seed = mutation
            try:
                outcome = getattr(mutator, form)(kind, seed)
            except Exception as error:
                outcome = {"outcome": f"{type(error).__name__}: {error}", "wrong": True}
            file.write(json.dumps(outcome) + "\n")


def outcomes_of(run: Callable[..., None], folder: Path, *further: str) -> list[tuple[Any, Outcome]]:
    """Outcome of every mutation, tried in a process that a crash of HDF5 may end."""
    process = multiprocessing.get_context("spawn").Process(target=run, args=(str(folder), *further))
    process.start()
    process.join(120)
    if process.is_alive():
        process.kill()
        process.join()
    lines = [json.loads(line) for line in (folder / "outcomes.jsonl").read_text().splitlines()]
    assert process.exitcode == 0, f"exit code {process.exitcode} in {lines[-1:]}"
    return [
        (mutation["mutation"], outcome)
        for mutation, outcome in zip(lines[::2], lines[1::2], strict=True)
    ]
