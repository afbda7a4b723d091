"""The spaces of a Minari data set's arrays, and rows that are checked against them."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.arrays import capacity, refuse_pointer
from torchrl_bmrl.data.hdf5 import DAMAGE, read_array, read_node
from torchrl_bmrl.data.schema import FLOAT32
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import parse_json

with needs("data"):
    import h5py

_SPACES = ("Box", "Discrete", "MultiBinary", "MultiDiscrete")
_JPEG = b"\xff\xd8\xff"
"""First bytes of every JPEG."""


@dataclass(frozen=True)
class Space:
    """Shape, dtype, and lowest and highest number of each row of an array."""

    shape: tuple[int, ...]
    dtype: np.dtype
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Space:
        """Reads a space as Minari writes it into ``metadata.json``."""
        kind = told["type"]
        dtype = np.dtype(told.get("dtype", "int8" if kind == "MultiBinary" else "int64"))
        start = np.asarray(told.get("start", 0))
        if kind == "Box":
            shape = tuple(told["shape"])
            low, high = (np.asarray(told[end], dtype=dtype) for end in ("low", "high"))
        elif kind == "Discrete":
            shape, low, high = (), start, start + told["n"] - 1
        elif kind == "MultiDiscrete":
            counts = np.asarray(told["nvec"])
            shape, low, high = counts.shape, start, start + counts - 1
        else:
            shape = tuple(np.atleast_1d(told["n"]).tolist())
            low, high = np.asarray(0), np.asarray(1)
        return cls(shape, dtype, np.broadcast_to(low, shape), np.broadcast_to(high, shape))

    @property
    def bounds(self) -> dict[str, Any] | None:
        """Bounds of a finite box of floating-point numbers; ``None`` for any other space."""
        whole = self.dtype.kind == "f" and bool(np.all(self.low < self.high))
        # Bounds as large as float32 allows are no bounds.
        if not whole or np.any(np.abs([self.low, self.high]) >= FLOAT32):
            return None
        low, high = _shortest(self.low), _shortest(self.high)
        # Only vectors have lists.
        lists = isinstance(low, list) or isinstance(high, list)
        return None if lists and len(self.shape) > 1 else {"low": low, "high": high}


def _shortest(bound: np.ndarray) -> float | list[float]:
    return float(bound.flat[0]) if np.all(bound == bound.flat[0]) else bound.tolist()


@dataclass(frozen=True)
class Spaces:
    """Spaces of the arrays by their keys below an episode, and the content of ``metadata.json``."""

    parts: dict[str, Space]
    actions: Space
    metadata: dict[str, Any]


def read_spaces(path: str | os.PathLike[str]) -> Spaces:
    """Reads ``metadata.json``.

    Raises:
        DataError: naming file and key, if it is missing, damaged, a git-LFS pointer, belongs to a
            storage other than HDF5, or has no space of numbers.
    """
    file = Path(path) / "data" / "metadata.json"
    try:
        refuse_pointer(file)
        metadata = parse_json(file.read_bytes())
        data_format = metadata.get("data_format", "hdf5")
        told = {"observations": parse_json(metadata["observation_space"])}
        if told["observations"]["type"] == "Dict":
            parts = told.pop("observations")["subspaces"]
            told = {f"observations/{part}": space for part, space in parts.items()}
        actions = parse_json(metadata["action_space"])
        # Other spaces are skipped, as long as one part of the observation remains.
        known = {key: space for key, space in told.items() if space["type"] in _SPACES}
        for key, space in {**(told if not known else {}), "actions": actions}.items():
            if space["type"] not in _SPACES:
                message = f"a space of type {space['type']}; valid: {', '.join(_SPACES)}"
                raise DataError(file, key, message)
        spaces = {key: Space.of(space) for key, space in known.items()}
        read = Spaces(spaces, Space.of(actions), metadata)
    except DataError:
        raise
    except KeyError as error:
        raise DataError(file, str(error.args[0]), "missing") from error
    except OSError as error:
        raise DataError(file, None, f"unreadable ({error.strerror})") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(file, None, f"not Minari's metadata ({error})") from error
    if data_format != "hdf5":
        raise DataError(file, "data_format", f"{data_format!r}; valid: 'hdf5'")
    if not spaces:
        raise DataError(file, "observation_space", "no part; valid: at least one")
    return read


def read_rows(
    path: Path, file: h5py.File, key: str, space: Space, *, exact: bool = False
) -> np.ndarray:
    """Reads the rows of an array and checks them against their space.

    Args:
        path: of the file, for messages.
        file: open for reading.
        key: of the array.
        space: of each row.
        exact: whether to refuse integers if the space has floating-point numbers.

    Raises:
        DataError: for rows of another shape or kind.
    """
    node = read_node(path, file, key)
    if isinstance(node, h5py.Dataset) and is_jpeg(node):
        # Arrays of bytes that are not JPEG have the shape of their space.
        meant = node.shape[1:] == space.shape
        if not meant or _shape(next(_open_images(path, key, node))) == _drop_ones(space.shape):
            return _decode(path, key, node, space)
    array = read_array(path, file, key)
    if array.ndim and array.shape[1:] != space.shape:
        valid = ", ".join(map(str, ("T", *space.shape)))
        raise DataError(path, key, f"shape {array.shape}; valid: ({valid}), as metadata.json says")
    floats = array.dtype.kind == "f", space.dtype.kind == "f"
    if floats[0] != floats[1] and (exact or floats[0]):
        message = f"dtype {array.dtype}; valid: {space.dtype}, as metadata.json says"
        raise DataError(path, key, message)
    return array


def is_jpeg(node: Any) -> bool:
    """Whether the rows of a dataset are JPEG files, of equal or different lengths."""
    if not isinstance(node, h5py.Dataset) or not node.size:
        return False
    if node.ndim == 1:
        kept_as_bytes = h5py.check_vlen_dtype(node.dtype) == np.uint8
    else:
        kept_as_bytes = node.ndim == 2 and node.dtype == np.uint8
    if not kept_as_bytes:
        return False
    try:
        return np.asarray(node[0]).tobytes().startswith(_JPEG)
    except DAMAGE:
        return False  # reported when it is read


def _decode(path: Path, key: str, node: h5py.Dataset, space: Space) -> np.ndarray:
    images = []
    if (claimed := len(node) * prod(space.shape)) > 2**20 + capacity(os.path.getsize(path)):
        message = f"claims {claimed} bytes of images, more than the file can hold"
        raise DataError(path, key, message)
    for i, image in enumerate(_open_images(path, key, node)):
        # Before decoding, which may take much memory.
        if _shape(image) != _drop_ones(space.shape):
            message = f"JPEG of shape {_shape(image)} in row {i}; valid: {space.shape}"
            raise DataError(path, key, f"{message}, as metadata.json says")
        try:
            images.append(np.asarray(image).reshape(space.shape))
        except (*DAMAGE, SyntaxError) as error:
            raise DataError(path, key, f"no JPEG in row {i} ({error})") from error
    return np.stack(images)


def _open_images(path: Path, key: str, node: h5py.Dataset) -> Iterator[Any]:
    with needs("data"):
        from PIL import Image
    for i in range(len(node)):
        try:
            row = np.asarray(node[i])  # one at a time: all may be the same, as long as the file
        except DAMAGE as error:
            raise DataError(path, key, f"unreadable ({error})") from error
        try:
            # Minari writes JPEG. Decoders of other formats may read other files or start programs.
            image = Image.open(io.BytesIO(row.tobytes()), formats=["JPEG"])
        except (*DAMAGE, SyntaxError, Image.DecompressionBombError) as error:
            raise DataError(path, key, f"no JPEG in row {i} ({error})") from error
        yield image


def _shape(image: Any) -> tuple[int, ...]:
    return _drop_ones((image.height, image.width, len(image.getbands())))


def _drop_ones(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A shape without trailing dimensions of 1, which images do not store."""
    while shape[-1:] == (1,):
        shape = shape[:-1]
    return shape
