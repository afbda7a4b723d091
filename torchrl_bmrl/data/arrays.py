"""Checks that the readers of all formats share: git-LFS pointers, numbers, flags, lengths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchrl_bmrl.errors import DataError

# In every function ``path`` and ``key`` name the file and the array in error messages, and
# ``first`` is the file's row that the first row of the array comes from.


def refuse_pointer(path: Path) -> None:
    """Refuses a missing file, and a git-LFS pointer in place of one.

    Raises:
        DataError: naming the file.
    """
    if not path.is_file():
        raise DataError(path, None, "a folder; valid: a file" if path.is_dir() else "no such file")
    with path.open("rb") as file:
        if file.read(23) == b"version https://git-lfs":
            message = "a git-LFS pointer, not the data; `git lfs pull` fetches them"
            raise DataError(path, None, message)


def capacity(stored: int) -> int:
    """Largest number of bytes that decompressing so many bytes can yield."""
    # gzip compresses zeros to about a thousandth, and nothing to less.
    return 1100 * stored


def check_finite(path: str | Path, key: str, array: np.ndarray, first: int = 0) -> None:
    """Refuses NaN and infinity.

    Raises:
        DataError: naming the row.
    """
    if array.dtype.kind == "f" and not (finite := np.isfinite(array)).all():
        row = first + int(np.argwhere(~finite)[0][0])
        raise DataError(path, key, f"a value that is not finite in row {row}")


def as_flags(path: str | Path, key: str, flags: np.ndarray, first: int = 0) -> np.ndarray:
    """Converts flags to booleans.

    Raises:
        DataError: for anything but 0 and 1, naming the row.
    """
    for where in map(tuple, np.argwhere((flags != 0) & (flags != 1))):
        raise DataError(path, key, f"{flags[where]} in row {first + where[0]}; valid: 0 or 1")
    return flags.astype(bool)


def as_column(path: str | Path, key: str, array: np.ndarray) -> np.ndarray:
    """Converts an array of one number in each row, ``(T,)`` or ``(T, 1)``, to ``(T,)``.

    Raises:
        DataError: for longer rows.
    """
    if array.shape[1:] not in ((), (1,)):
        raise DataError(path, key, f"rows of shape {array.shape[1:]}; valid: one number in each")
    return array.reshape(len(array))


def check_lengths(
    path: str | Path,
    prefix: str,
    shapes: Mapping[str, tuple[int, ...]],
    *,
    one_more: tuple[str, ...] = (),
    steps: int | None = None,
) -> int:
    """Refuses arrays whose numbers of rows do not agree.

    Args:
        path: file, for messages.
        prefix: of the keys, for messages.
        shapes: of the arrays by key.
        one_more: keys of arrays that have a row after the last step.
        steps: the valid number of steps; that of most arrays if ``None``.

    Returns:
        the number of steps.

    Raises:
        DataError: naming an array that is not an array of rows, has another number of rows than
            most arrays, or has none.
    """
    for key, shape in shapes.items():
        if not shape:
            raise DataError(path, prefix + key, "one number; valid: a row for each step")
    counts = Counter(shape[0] - (key in one_more) for key, shape in shapes.items())
    # If one array differs from all others, it is at fault, even if it is the actions.
    steps = counts.most_common(1)[0][0] if steps is None else steps
    for key, shape in shapes.items():
        if shape[0] != steps + (key in one_more):
            message = f"shape {shape}; valid: {steps + (key in one_more)} rows"
            raise DataError(path, prefix + key, f"{message}, since most arrays have {steps} steps")
    if steps < 1:
        key = next(iter(shapes))
        raise DataError(path, prefix + key, f"shape {shapes[key]}; valid: at least one row")
    return steps
