"""Numbers of a file that are to be finite, or flags."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchrl_bmrl.errors import DataError


def check_finite(path: str | Path, key: str, array: np.ndarray, first: int = 0) -> None:
    """Refuses NaN and infinity.

    Args:
        path: of the file, for messages.
        key: of the array in the file, for messages.
        array: with a row for each step.
        first: row of the file that the first of them is.

    Raises:
        DataError: naming the row.
    """
    if array.dtype.kind == "f" and not (finite := np.isfinite(array)).all():
        row = first + int(np.argwhere(~finite)[0][0])
        raise DataError(path, key, f"a value that is not finite in row {row}")


def as_flags(path: str | Path, key: str, flags: np.ndarray, first: int = 0) -> np.ndarray:
    """Flags as booleans.

    Args:
        path: of the file, for messages.
        key: of the array in the file, for messages.
        flags: with a row for each step.
        first: row of the file that the first of them is.

    Raises:
        DataError: for anything but 0 and 1, naming the row.
    """
    for where in map(tuple, np.argwhere((flags != 0) & (flags != 1))):
        raise DataError(path, key, f"{flags[where]} in row {first + where[0]}; valid: 0 or 1")
    return flags.astype(bool)
