"""Edits of HDF5 and JSON files, with which tests damage good files or add to them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Edit = Callable[[Any], object]
"""Changes an open HDF5 file or a group of it."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345\n"
"""What Git stores in place of a file that it keeps in LFS."""


def edit(path: Path, *edits: Edit) -> None:
    """Applies edits to an HDF5 file, one after the other."""
    with h5py.File(path, "r+") as file:
        for each in edits:
            each(file)


def put(key: str, value: Any) -> Edit:
    """An edit that writes a value under a key and replaces what was there."""

    def put_value(group: Any) -> None:
        if key in group:
            del group[key]
        group[key] = value

    return put_value


def remove(*keys: str) -> Edit:
    """An edit that deletes keys."""

    def remove_keys(group: Any) -> None:
        for key in keys:
            del group[key]

    return remove_keys


def change(key: str, index: Any, value: float) -> Edit:
    """An edit that changes some numbers of an array."""

    def change_numbers(group: Any) -> None:
        group[key][index] = value

    return change_numbers


def rewrite(group: Any, key: str, function: Callable[[np.ndarray], Any]) -> None:
    """Replaces an array by what a function makes of it."""
    put(key, function(group[key][()]))(group)


def as_group(group: Any, key: str) -> None:
    """Replaces an array by a group."""
    del group[key]
    group.create_group(key)["x"] = 1.0


def first_chunk(path: Path, key: str) -> slice:
    """Bytes of a file that hold the first chunk of an array."""
    with h5py.File(path) as file:
        chunk = file[key].id.get_chunk_info(0)
    return slice(chunk.byte_offset, chunk.byte_offset + chunk.size)


def layout_version(path: Path, key: str) -> int:
    """Version of an array's layout message, as HDF5's specification describes its header.

    HDF5 1.10 to 1.14 read versions up to 4 and refuse version 5 of HDF5 2.0.
    """
    with h5py.File(path) as file:
        address = h5py.h5o.get_info(file[key].id).addr
    content = path.read_bytes()
    assert content[address : address + 5] == b"OHDR\x02"
    flags = content[address + 5]
    place = address + 6 + 16 * bool(flags & 32) + 4 * bool(flags & 16)
    width = 1 << (flags & 3)
    stop = place + width + int.from_bytes(content[place : place + width], "little")
    place += width
    while place < stop:  # type (1), size (2), flags (1), order (2, where flags & 4), content
        kind, size = content[place], int.from_bytes(content[place + 1 : place + 3], "little")
        place += 4 + 2 * bool(flags & 4)
        if kind == 8:
            return content[place]
        place += size
    raise AssertionError("no layout message")


def edit_json(path: Path, **changes: Any) -> None:
    """Changes entries of a JSON object in a file; ``None`` removes an entry."""
    entries = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({key: value for key, value in entries.items() if value is not None}))
