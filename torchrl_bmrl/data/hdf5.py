"""Reads HDF5 files that may be damaged, and writes arrays and attributes with checksums."""

from __future__ import annotations

import os
import re
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.arrays import capacity, refuse_pointer
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs

with needs("data"):
    import h5py

VERSION = ("v110", "v110")
"""HDF5's structures to write: the default ones have no checksums, and "latest" could only be read
by the version that wrote it."""
DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, MemoryError)
"""Errors that h5py raises on a damaged file, depending on where the damage is."""
_MOST_LINKS = 16
"""Soft links that one key may lead through."""


def open_file(path: str | Path) -> h5py.File:
    """Opens a file for reading.

    Raises:
        DataError: if it is missing, not a complete HDF5 file, or a git-LFS pointer to one.
    """
    try:
        refuse_pointer(Path(path))
        return h5py.File(path, "r")
    except DataError:
        raise
    except DAMAGE as error:
        if isinstance(error, BlockingIOError):  # HDF5's lock
            message = "in use: another process has it open for writing; valid: a closed file"
            raise DataError(path, None, message) from error
        raise DataError(path, None, f"not a complete HDF5 file ({error})") from error


def update_digests(digests: Iterable[Any], path: str | Path, file: h5py.File) -> None:
    """Adds the bytes of an open file to digests: of this file, even if its name has another now.

    Args:
        digests: hashlib's.
        path: of the file, for messages.
        file: open for reading.

    Raises:
        DataError: if it cannot be read.
    """
    try:
        handle, start = file.id.get_vfd_handle(), 0
        while block := os.pread(handle, 1 << 20, start):
            for digest in digests:
                digest.update(block)
            start += len(block)
    except DAMAGE as error:
        raise DataError(path, None, f"unreadable ({error})") from error


@contextmanager
def _reading(path: str | Path, key: str, what: str = "") -> Iterator[None]:
    """Turns what h5py raises on damage into an error that names file and key."""
    try:
        yield
    except DataError:
        raise
    except DAMAGE as error:
        raise DataError(path, key, f"{what}unreadable ({error})") from error


def read_names(path: str | Path, file: h5py.File, key: str) -> list[str]:
    """Names in a group, ``demo_2`` before ``demo_10``.

    Raises:
        DataError: if there is no such group, or it cannot be read.
    """
    with _reading(path, key):
        group = _within(path, file, key)
        if isinstance(group, h5py.Group):
            return sorted(group, key=_natural)
    raise DataError(path, key, "missing; valid: a group" if group is None else "not a group")


def read_node(path: str | Path, file: h5py.File, key: str) -> Any:
    """A group or dataset; ``None`` if it is missing or a link to a missing node.

    Raises:
        DataError: if it cannot be read, or lies in another file.
    """
    with _reading(path, key):
        return _within(path, file, key)


def _within(path: str | Path, file: h5py.File, key: str) -> Any:
    """A node whose content lies in this file and is not larger than the file can hold.

    Raises:
        DataError: if it is damaged, lies in another file, or claims more bytes than decompressing
            this file can yield.
    """
    names = _refuse_links_out(path, file, key)
    node = file.get(key)
    # h5py returns the same for a missing node and for one that it cannot open.
    if node is None and isinstance(file.get(key, getlink=True), h5py.HardLink):
        raise DataError(path, key, "unreadable: it is there, and damaged")
    if isinstance(node, h5py.Dataset):
        if node.external or node.is_virtual:
            raise DataError(path, key, "its content lies in other files; valid: in this file")
        # Rows that were never written take no space. An array with several names is read as often.
        written = os.path.getsize(path) + 2**16 + capacity(node.id.get_storage_size())
        times = prod(h5py.h5o.get_info(file.id, name).rc for name in names)
        if node.nbytes > written or times * node.nbytes > 2**20 + capacity(os.path.getsize(path)):
            often = f" under {times} names" if times > 1 else ""
            message = f"claims {node.nbytes} bytes{often}, more than the file can hold"
            raise DataError(path, key, message)
    return node


def _refuse_links_out(path: str | Path, file: h5py.File, key: str) -> list[bytes]:
    """Follows a key link by link, because HDF5 itself opens the file that a link names.

    Returns:
        keys of the groups on the way and of the node, without soft links.

    Raises:
        DataError: for a link to another file, and for more links than a path has.
    """
    names, done, links = _parts_of(key), b"", 0
    passed: list[bytes] = []
    while names:
        here = done + b"/" + names.pop(0)
        try:
            kind = file.id.links.get_info(here).type
        except DAMAGE:  # missing or damaged, as whoever opens it will find, too
            break
        if kind == h5py.h5l.TYPE_HARD:
            done = here
            passed.append(here)
        elif kind == h5py.h5l.TYPE_SOFT and links < _MOST_LINKS:
            links += 1
            target = file.id.links.get_val(here)
            names = [*_parts_of(target), *names]
            done = b"" if target.startswith(b"/") else done
        else:
            where = f"lies in {_text(file.id.links.get_val(here)[0])}"
            where = "a link to itself" if kind == h5py.h5l.TYPE_SOFT else where
            raise DataError(path, key, f"{where}; valid: in this file")
    return passed


def _parts_of(key: str | bytes) -> list[bytes]:
    whole = key.encode("utf-8", "surrogateescape") if isinstance(key, str) else key
    return [part for part in whole.split(b"/") if part not in (b"", b".")]


def _natural(name: str) -> list[tuple[int, str]]:
    # Numbers sort by value and the rest as text: (number, "") and (-1, text) can be compared.
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def read_array(
    path: str | Path, file: h5py.File, key: str, rows: slice | None = None
) -> np.ndarray:
    """Reads the numbers of a dataset.

    Args:
        path: of the file, for messages.
        file: open for reading.
        key: of the dataset.
        rows: those to read; ``None`` for all.

    Raises:
        DataError: if it is missing, a group, cannot be read, or has other content than numbers.
    """
    with _reading(path, key):
        node = _dataset(path, file, key)
        if node.dtype.kind not in "biuf":
            raise DataError(path, key, f"dtype {node.dtype}; valid: numbers")
        array = np.asarray(node[() if rows is None else rows])
        return array.astype(array.dtype.newbyteorder("="), copy=False)  # as torch needs it


def read_strings(path: str | Path, file: h5py.File, key: str) -> list[str]:
    """Reads the strings of a dataset, bytes or text.

    Raises:
        DataError: if it is missing, a group, or cannot be read, or claims more texts than the file
            can hold.
    """
    with _reading(path, key):
        node = _dataset(path, file, key)
        size = os.path.getsize(path)
        # Each text names an episode, whose group alone takes more.
        if node.size is None or node.size > 2**10 + size // 64:
            message = f"claims {node.size} texts, more than the file can name"
            raise DataError(path, key, message)
        if not node.dtype.hasobject or not node.ndim:
            return [_text(value) for value in np.asarray(node[()]).reshape(-1)]
        # Texts of variable length lie elsewhere in the file, and many rows may name the same.
        texts: list[str] = []
        left, step = 2**20 + size, max(1, 2**24 // size)
        for start in range(0, len(node), step):
            more = [_text(value) for value in np.asarray(node[start : start + step]).reshape(-1)]
            left -= sum(map(len, more))
            if left < 0:
                raise DataError(path, key, "its texts are longer than the file")
            texts += more
        return texts


def _dataset(path: str | Path, file: h5py.File, key: str) -> h5py.Dataset:
    node = _within(path, file, key)
    if not isinstance(node, h5py.Dataset):
        raise DataError(path, key, "missing" if node is None else "a group; valid: a dataset")
    return node


def read_attributes(path: str | Path, file: h5py.File, key: str) -> dict[str, Any]:
    """Attributes of a group: text as ``str``, arrays as lists, numbers as Python's.

    Raises:
        DataError: if they cannot be read.
    """
    with _reading(path, key, "attributes "):
        _refuse_links_out(path, file, key)
        held = file[key].attrs
        return {name: _attribute(path, key, held, name) for name in held}


def read_attribute(path: str | Path, file: h5py.File, key: str, name: str) -> Any:
    """One attribute of a group, converted as by :func:`read_attributes`; ``None`` if missing.

    Raises:
        DataError: if it cannot be read.
    """
    with _reading(path, key, f"attribute {name} "):
        _refuse_links_out(path, file, key)
        held = file[key].attrs
        return _attribute(path, key, held, name) if name in held else None


def _attribute(path: str | Path, key: str, held: h5py.AttributeManager, name: str) -> Any:
    stored = held.get_id(name)
    count = prod(stored.shape or ())
    # HDF5 reads all at once, and each of them may be the same text, as long as the file.
    if stored.dtype.hasobject and count > 64 and count * os.path.getsize(path) > 2**26:
        message = f"attribute {name} has {count} texts of any length; valid: of a fixed length"
        raise DataError(path, key, message)
    return _plain(held[name])


def has_rows(node: Any, *counts: int) -> bool:
    """Whether a node is an array of numbers with one of these numbers of rows."""
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "biuf":
        return False
    return bool(node.ndim and node.size) and node.shape[0] in counts


def write_array(group: h5py.Group, key: str, array: np.ndarray, **options: Any) -> None:
    """Writes a compressed array with checksums.

    The checksum of zeros is zero, so a hole in a file would pass for data; compressed zeros differ
    from a hole. An array without elements has no chunks, which checksums and filters need.
    """
    filters = {"compression": "gzip", "compression_opts": 1, "fletcher32": True, **options}
    group.create_dataset(key, data=array, **(filters if array.size else {}))


def write_attributes(group: h5py.Group, attributes: Mapping[str, Any]) -> None:
    """Writes numbers, texts and lists of them so that damage is detected when they are read.

    Raises:
        ConfigError: for other attributes.
    """
    for name, value in attributes.items():
        try:
            _write_attribute(group, name, value)
        except (OverflowError, TypeError, ValueError) as error:
            raise ConfigError(
                f"attribute {name} is {reprlib.repr(value)}; valid: a number, a text, or a list of "
                f"one of them ({error})"
            ) from error


def _write_attribute(group: h5py.Group, name: str, value: Any) -> None:
    texts = [value] if isinstance(value, str) else value
    if isinstance(texts, list | tuple) and all(isinstance(text, str) for text in texts):
        # Texts of fixed length lie in the group's header, which has a checksum. h5py's texts of
        # variable length lie in a heap without one; if damaged, HDF5 may loop forever.
        encoded = [text.encode() for text in texts]
        length = max([1, *map(len, encoded)])
        array = np.array(encoded if texts is value else encoded[0], dtype=f"S{length}")
        group.attrs.create(name, array, dtype=h5py.string_dtype("utf-8", length))
    elif isinstance(value, h5py.Reference):
        raise TypeError("it refers into another file")
    else:
        group.attrs[name] = value


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(element) for element in value.tolist()]
    if isinstance(value, bytes | str):
        return _text(value)
    return value.item() if isinstance(value, np.generic) else value


def _text(value: Any) -> str:
    """Text that can be shown and written: what is not UTF-8 becomes U+FFFD."""
    # h5py hides such bytes in a text of variable length.
    raw = value if isinstance(value, bytes) else str(value).encode(errors="surrogateescape")
    return raw.decode(errors="replace")
