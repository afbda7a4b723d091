"""The files that a data set consists of, and whether they change while it is read."""

from __future__ import annotations

import os
from pathlib import Path

from torchrl_bmrl.errors import DataError

HDF5 = (".hdf5", ".h5")
READ = (*HDF5, ".json", ".jsonl", ".parquet")
"""Ends of the files that are read in the folder of a data set; pictures and films are not."""
CHANGED = "changed while it was read; valid: a file that no process writes or replaces"


def files_of(source: str | os.PathLike[str]) -> list[Path]:
    """The files that decide what is read from a data set.

    Args:
        source: a file or folder as :func:`~torchrl_bmrl.data.importing.import_demonstrations` reads
            it. Models beside an HDF5 file belong to it, as in a recording of robosuite.

    Returns:
        the files, sorted; none if there is no such file or folder.

    Example:
        >>> files_of("nowhere.hdf5")
        []
    """
    path = Path(source).expanduser()
    if not path.is_dir():
        models = (path.parent / "models").glob("*.xml") if path.suffix in HDF5 else ()
        return [path, *sorted(models)] if path.is_file() else []
    whole = [file for file in path.glob("*") if file.suffix in HDF5 and file.is_file()]
    inside = (file for file in path.rglob("*") if file.suffix in READ and file.is_file())
    return sorted(whole or inside)


Identity = dict[Path, tuple[int, ...]]
"""What the file system says about each file of a data set."""


def identity_of(source: str | os.PathLike[str]) -> Identity:
    """What the file system says about the files of a data set: number, size and time of change.

    Args:
        source: as for :func:`files_of`.
    """
    found = {path: path.stat() for path in files_of(source)}
    return {path: (x.st_dev, x.st_ino, x.st_size, x.st_mtime_ns) for path, x in found.items()}


def check_unchanged(source: Path, before: Identity) -> None:
    """Refuses a data set that was written to, or replaced, while it was read.

    Args:
        source: as for :func:`files_of`.
        before: its :func:`identity_of` when it was opened.

    Raises:
        DataError: naming the first file that changed.
    """
    now = identity_of(source)
    for path in sorted(now.keys() | before.keys()):
        if now.get(path) != before.get(path):
            raise DataError(path, None, CHANGED)
