"""Reads the folder ``meta`` of a LeRobot data set, which states where each episode lies."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_bmrl.data.arrays import capacity, refuse_pointer
from torchrl_bmrl.data.schema import MAX_FPS
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import parse_json, read_json

_OLD, _NEW = ("v2.0", "v2.1"), ("v3.0",)
_OLD_FILE = "data/chunk-{chunk:03d}/episode_{episode:06d}.parquet"
_PLACE = ("data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index")
_NEW_FILE = "data/chunk-{chunk:03d}/file-{file:03d}.parquet"


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Position of an episode: its file, first row in it, number of rows, and first index."""

    file: str
    start: int
    count: int
    index: int
    task: str


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The content of the folder ``meta``.

    Attributes:
        path: the data set's folder.
        info: content of ``info.json``.
        episodes: position of each episode, by name.
        steps: number of rows of each data file.
    """

    path: Path
    info: Mapping[str, Any]
    episodes: Mapping[str, Rows]
    steps: Mapping[str, int]

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> Layout:
        """Reads and checks the folder ``meta``.

        Raises:
            DataError: naming file and row, for an unknown version, episodes whose rows do not
                follow one another, and data files that belong to no episode.
        """
        path = Path(path)
        info = _read_info(path)
        new = info["codebase_version"] in _NEW
        listed = (
            _read_table(path, "meta/episodes") if new else _ordered(_read_lines(path, "episodes"))
        )
        rows: dict[str, Rows] = {}
        first_of_file: dict[str, int] = {}
        steps_of_file: dict[str, int] = {}
        start = 0
        for i, row in enumerate(listed):
            where = f"row {i}"
            number, count = (_whole(path, row, key, where) for key in ("episode_index", "length"))
            if number != i or count < 1:
                message = f"{where}: episode_index {number}, length {count}; valid: {i}, 1 or more"
                raise DataError(path, "meta/episodes", message)
            if new:
                chunk, file, begin, end = (_whole(path, row, key, where) for key in _PLACE)
                if (begin, end) != (start, start + count):
                    message = f"{where}: rows {begin} to {end}; valid: {start} to {start + count}"
                    raise DataError(path, "meta/episodes", message)
                name = _NEW_FILE.format(chunk=chunk, file=file)
            else:
                chunk = i // info.get("chunks_size", 1000)
                name = _OLD_FILE.format(chunk=chunk, episode=i)
            first = first_of_file.setdefault(name, start)
            steps_of_file[name] = steps_of_file.get(name, 0) + count
            tasks = row.get("tasks")
            tasks = tasks if isinstance(tasks, list) else [tasks]
            rows[f"episode_{i}"] = Rows(
                file=name,
                start=start - first,
                count=count,
                index=start,
                task=", ".join(str(task) for task in tasks if task is not None),
            )
            start += count
        if not rows:
            raise DataError(path, "meta/episodes", "no episodes; valid: at least one")
        for stray in sorted((path / "data").rglob("*.parquet")):
            # LeRobot would read its steps, too.
            if str(stray.relative_to(path).as_posix()) not in steps_of_file:
                raise DataError(stray, None, "in no episode; valid: a file that meta lists")
        return cls(path=path, info=info, episodes=rows, steps=steps_of_file)


def _read_info(path: Path) -> dict[str, Any]:
    file = path / "meta" / "info.json"
    refuse_pointer(file)
    info = read_json(file, "LeRobot's description of a data set")
    if not isinstance(info, dict):
        raise DataError(file, None, f"{type(info).__name__}; valid: a JSON object")
    version = info.get("codebase_version")
    if version not in (*_OLD, *_NEW):
        message = f"{version!r}; valid: {', '.join((*_OLD, *_NEW))}"
        raise DataError(file, "codebase_version", message)
    if not isinstance(info.get("features"), dict):
        raise DataError(file, "features", "missing; valid: a JSON object")
    # bool is an int in Python.
    fps, chunks_size = info.get("fps"), info.get("chunks_size", 1000)
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < MAX_FPS:
        raise DataError(file, "fps", f"{fps!r}; valid: a positive number")
    if not isinstance(chunks_size, int) or isinstance(chunks_size, bool) or chunks_size < 1:
        raise DataError(file, "chunks_size", f"{chunks_size!r}; valid: 1 or more")
    return info


def _whole(path: Path, row: Mapping[str, Any], key: str, where: str) -> int:
    value = row.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        message = f"{where}: {key} is {value!r}; valid: a whole number"
        raise DataError(path, "meta", message)
    return value


def _read_lines(path: Path, name: str) -> list[dict[str, Any]]:
    file = path / "meta" / f"{name}.jsonl"
    refuse_pointer(file)
    rows = []
    try:
        # Not splitlines: texts may contain other line ends, such as U+2028.
        lines = file.read_text(encoding="utf-8").split("\n")
        for number, line in enumerate(lines, 1):
            row = parse_json(line) if line.strip() else None
            if not isinstance(row, dict | None):
                raise DataError(file, f"line {number}", "valid: a JSON object")
            rows += [] if row is None else [row]
    except DataError:
        raise
    except (OSError, ValueError) as error:
        raise DataError(file, None, f"not JSON, a line for each episode ({error})") from error
    return rows


def _read_table(path: Path, name: str) -> list[dict[str, Any]]:
    files = sorted((path / name).rglob("*.parquet"))
    if not files:
        raise DataError(path / name, None, "no parquet file; valid: at least one")
    rows = []
    keys = ("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index")
    for file in files:
        with open_parquet(file) as parquet:
            present = [
                key for key in parquet.schema_arrow.names if key in keys or key.startswith("data/")
            ]
            left = 2**22 + 32 * file.stat().st_size
            # A text that is stored once may be that of many rows.
            for batch in parquet.iter_batches(batch_size=64, columns=present):
                left -= batch.nbytes
                if left < 0:
                    raise DataError(file, None, "its rows are longer than the file can hold")
                rows += batch.to_pylist()
    return _ordered(rows)


def _ordered(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (str(type(row.get("episode_index"))), _order(row)))


def _order(row: Mapping[str, Any]) -> int:
    number = row.get("episode_index")
    return number if isinstance(number, int) else 0


@contextmanager
def open_parquet(file: Path) -> Iterator[Any]:
    """Opens a parquet file; errors of pyarrow inside the block become a DataError."""
    refuse_pointer(file)
    with needs("data"):
        import pyarrow as pa
        from pyarrow.parquet import ParquetFile
    try:
        with ParquetFile(file, page_checksum_verification=True) as parquet:
            _check_size(file, parquet.metadata)
            yield parquet
    except DataError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, OverflowError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise DataError(file, None, f"not a whole parquet file ({reason})") from error


def _check_size(file: Path, metadata: Any) -> None:
    """Refuses a file of more rows or numbers than its bytes can hold; equal ones take none."""
    size, rows = file.stat().st_size, metadata.num_rows
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    values = sum(group.column(i).num_values for group in groups for i in range(group.num_columns))
    # Each row has its own index, and a number takes 8 bytes at most.
    if rows > 2**12 + size or 8 * values > 2**20 + capacity(size):
        message = f"claims {rows} rows and {values} values, more than the file can hold"
        raise DataError(file, None, message)
