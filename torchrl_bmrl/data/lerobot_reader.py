"""The reading half of :mod:`torchrl_bmrl.data.lerobot`: layouts v2.0, v2.1 and v3.0.

What older versions have otherwise::

    data/chunk-000/episode_000000.parquet      a file for each episode
    meta/episodes.jsonl                        a line for each episode
    meta/tasks.jsonl                           a line for each task

Pages of parquet files may carry checksums, as those do that this library writes; where they do, a
flipped bit is found. Images and videos are left alone, and what is after the last step is not in
the layout.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import LazyEpisodes
from torchrl_bmrl.data.raw import RawEpisode
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import read_json

_OLD, _NEW = ("v2.0", "v2.1"), ("v3.0",)
_OLD_FILE = "data/chunk-{chunk:03d}/episode_{episode:06d}.parquet"
_NEW_FILE = "data/chunk-{chunk:03d}/file-{file:03d}.parquet"
_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_STEPS = ("next.reward", "next.done", "next.success", "next.terminated")
_SLACK = 1e-3
"""By how much a step's timestamp may be off, as a share of the time since the first: float32."""


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Where an episode lies: its file, its first row there, its rows, and its place in the set."""

    file: str
    start: int
    count: int
    index: int
    task: str


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """What the folder ``meta`` says of a data set."""

    path: Path
    info: Mapping[str, Any]
    episodes: Mapping[str, _Rows]
    steps: Mapping[str, int]

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> _Layout:
        path = Path(path)
        info = _read_info(path)
        new = info["codebase_version"] in _NEW
        listed = (
            _read_table(path, "meta/episodes") if new else _ordered(_read_lines(path, "episodes"))
        )
        rows: dict[str, _Rows] = {}
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
                chunk, file, begin, end = (
                    _whole(path, row, key, where)
                    for key in (
                        "data/chunk_index",
                        "data/file_index",
                        "dataset_from_index",
                        "dataset_to_index",
                    )
                )
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
            rows[f"episode_{i}"] = _Rows(
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
                raise DataError(stray, None, "in no episode; valid: a file that meta tells of")
        return cls(path=path, info=info, episodes=rows, steps=steps_of_file)


@contextmanager
def open_raw(path: str | os.PathLike[str]) -> Iterator[Mapping[str, RawEpisode]]:
    """Opens a data set; an episode is read when it is asked for.

    Every column ``observation.<part>`` of numbers is a part. Where the features name each number
    ``<part>.<i>``, as this library writes ``observation.state``, those are the parts. ``action``,
    ``next.reward``, ``next.done``, ``next.terminated`` and ``next.success`` become actions,
    rewards, dones, terminations and the extra ``successes``; other columns of numbers are extras,
    and the task's text is the attribute ``task``. Images, videos and texts are named in
    ``left_alone``.

    Args:
        path: the data set's folder, which holds ``meta/info.json``.

    Yields:
        the episodes as ``episode_0``, ``episode_1``, ...; to be read inside the block.

    Raises:
        DataError: naming file, column and row, for a file that is missing, damaged or a git-LFS
            pointer, another version of the layout, and indices that contradict each other. What
            concerns one episode is raised when that is read.
        MissingExtraError: if pyarrow is not installed.
    """
    layout = _Layout.of(path)
    tables = _Tables(layout)

    def read(name: str) -> RawEpisode:
        return _read_episode(layout, name, tables)

    yield LazyEpisodes(layout.episodes, read)


def read_metadata(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a data set says about itself: ``dataset_id``, ``fps``, ``robot_type``, its one ``task``.

    Raises:
        DataError: as :func:`open_raw`.
    """
    layout = _Layout.of(path)
    told: dict[str, Any] = {"dataset_id": layout.path.resolve().name}
    fps = layout.info.get("fps")
    if isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps < float("inf"):
        told["fps"] = float(fps)
    if isinstance(robot := layout.info.get("robot_type"), str):
        told["robot_type"] = robot
    tasks = {rows.task for rows in layout.episodes.values()}
    if len(tasks) == 1 and (task := tasks.pop()):
        told["task"] = task
    return told


def find_oddities(path: str | os.PathLike[str]) -> list[str]:
    """What deserves a look in a data set beside its episodes: warnings.

    Raises:
        DataError: as :func:`open_raw`.
    """
    layout = _Layout.of(path)
    oddities = []
    steps = sum(rows.count for rows in layout.episodes.values())
    for key, found in (("total_episodes", len(layout.episodes)), ("total_frames", steps)):
        said = layout.info.get(key)
        if said is not None and said != found:
            oddities.append(f"meta/info.json: {key} says {said}, there are {found}")
    videos = [
        key
        for key, feature in layout.info["features"].items()
        if isinstance(feature, dict) and feature.get("dtype") in ("video", "image")
    ]
    if videos:
        oddities.append(f"left alone, as pictures: {', '.join(videos)}")
    return oddities


# -- meta ------------------------------------------------------------------------------------------


def _read_info(path: Path) -> dict[str, Any]:
    file = path / "meta" / "info.json"
    _refuse_pointer(file)
    info = read_json(file, "LeRobot's description of a data set")
    if not isinstance(info, dict):
        raise DataError(file, None, f"{type(info).__name__}; valid: a JSON object")
    version = info.get("codebase_version")
    if version not in (*_OLD, *_NEW):
        message = f"{version!r}; valid: {', '.join((*_OLD, *_NEW))}"
        raise DataError(file, "codebase_version", message)
    if not isinstance(info.get("features"), dict):
        raise DataError(file, "features", "missing; valid: a JSON object")
    fps, chunks_size = info.get("fps"), info.get("chunks_size", 1000)
    # bool is an int in Python; a larger number is no rate, and may be no float.
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < 1e9:
        raise DataError(file, "fps", f"{fps!r}; valid: a positive number")
    if not isinstance(chunks_size, int) or isinstance(chunks_size, bool) or chunks_size < 1:
        raise DataError(file, "chunks_size", f"{chunks_size!r}; valid: 1 or more")
    return info


def _refuse_pointer(file: Path) -> None:
    if not file.is_file():
        raise DataError(file, None, "no such file")
    with file.open("rb") as stream:
        if stream.read(23) == b"version https://git-lfs":
            message = "a git-LFS pointer, not the data; `git lfs pull` fetches them"
            raise DataError(file, None, message)


def _whole(path: Path, row: Mapping[str, Any], key: str, where: str) -> int:
    value = row.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        message = f"{where}: {key} is {value!r}; valid: a whole number"
        raise DataError(path, "meta", message)
    return value


def _read_lines(path: Path, name: str) -> list[dict[str, Any]]:
    file = path / "meta" / f"{name}.jsonl"
    _refuse_pointer(file)
    rows = []
    try:
        # Not splitlines: a text may hold other ends of lines, such as U+2028.
        lines = file.read_text(encoding="utf-8").split("\n")
        for number, line in enumerate(lines, 1):  # no other ends
            row = json.loads(line) if line.strip() else None
            if not isinstance(row, dict | None):
                raise DataError(file, f"line {number}", "valid: a JSON object")
            rows += [] if row is None else [row]
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(file, None, f"not JSON, a line for each episode ({error})") from error
    return rows


def _read_table(path: Path, name: str) -> list[dict[str, Any]]:
    files = sorted((path / name).rglob("*.parquet"))
    if not files:
        raise DataError(path / name, None, "no parquet file; valid: at least one")
    rows = []
    keys = ("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index")
    for file in files:
        with _opened(file) as parquet:
            present = [
                key for key in parquet.schema_arrow.names if key in keys or key.startswith("data/")
            ]
            rows += parquet.read(columns=present).to_pylist()
    return _ordered(rows)


def _ordered(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (str(type(row.get("episode_index"))), _order(row)))


def _order(row: Mapping[str, Any]) -> int:
    number = row.get("episode_index")
    return number if isinstance(number, int) else 0


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """A parquet file; whatever pyarrow raises inside becomes a DataError."""
    _refuse_pointer(file)
    with needs("data"):
        import pyarrow as pa
        from pyarrow.parquet import ParquetFile
    try:
        with ParquetFile(file, page_checksum_verification=True) as parquet:
            yield parquet
    except DataError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, OverflowError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise DataError(file, None, f"not a whole parquet file ({reason})") from error


# -- data ------------------------------------------------------------------------------------------


class _Tables:
    """Numbers of one data file at a time: neighbouring episodes share it."""

    def __init__(self, layout: _Layout) -> None:
        self.layout = layout
        self.name: str | None = None
        self.table: Any = None
        self.left_alone: list[str] = []

    def read(self, name: str) -> Any:
        """The columns of numbers of a data file."""
        if name != self.name:
            with _opened(self.layout.path / name) as parquet:
                fields = {field.name: field.type for field in parquet.schema_arrow}
                self._check(self.layout.path / name, parquet, fields)
                numbers = [key for key, kind in fields.items() if _holds_numbers(kind)]
                self.table = parquet.read(columns=numbers)
            self.left_alone = [key for key in fields if key not in numbers]
            self.name = name
        return self.table

    def _check(self, file: Path, parquet: Any, fields: Mapping[str, Any]) -> None:
        rows = parquet.metadata.num_rows
        valid = self.layout.steps[file.relative_to(self.layout.path).as_posix()]
        if rows != valid:
            raise DataError(file, None, f"{rows} rows; valid: {valid}, as meta/episodes says")
        for key in parquet.schema_arrow.names:
            if parquet.schema_arrow.names.count(key) > 1:
                raise DataError(file, key, "several columns of this name; valid: one")
        for key, feature in self.layout.info["features"].items():
            told = feature.get("dtype") if isinstance(feature, dict) else None
            if told != "video" and key not in fields:
                raise DataError(file, key, "missing, but meta/info.json tells of it")


def _holds_numbers(kind: Any) -> bool:
    with needs("data"):
        import pyarrow as pa
    # datasets' arrays of several dimensions, once that package is imported.
    kind = kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind
    while (
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    ):
        kind = kind.value_type
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _read_episode(layout: _Layout, name: str, tables: _Tables) -> RawEpisode:
    rows = layout.episodes[name]
    file = layout.path / rows.file
    table = tables.read(rows.file)
    part = table.slice(rows.start, rows.count)
    arrays = {key: _array(file, key, part[key], rows.start) for key in part.column_names}
    number = int(name.rpartition("_")[2])
    _check_indices(layout, file, arrays, rows, number)
    if "action" not in arrays:
        raise DataError(file, "action", "missing; valid: numbers, a row for each step")
    steps = {
        key: _one_number(file, key, arrays[key], rows.start) for key in _STEPS if key in arrays
    }
    observations = _parts(layout, arrays)
    known = {
        "action",
        *_INDICES,
        *_STEPS,
        *(key for key in arrays if key.startswith("observation.")),
    }
    extras = {key: array for key, array in arrays.items() if key not in known}
    flags = {
        key: _flags(file, key, steps[key], rows.start)
        for key in ("next.done", "next.success", "next.terminated")
        if key in steps
    }
    if "next.success" in flags:
        extras["successes"] = flags["next.success"]
    return RawEpisode(
        observations=observations,
        actions=_column(arrays["action"]),
        rewards=steps.get("next.reward"),
        dones=flags.get("next.done"),
        terminated=flags.get("next.terminated"),
        extras=extras,
        attributes={"task": rows.task} if rows.task else {},
        left_alone=tuple(tables.left_alone),
    )


def _array(file: Path, key: str, column: Any, start: int) -> np.ndarray:
    """A column of numbers, or of lists of them of one length, as ``(T, ...)``."""
    with needs("data"):
        import pyarrow as pa
        import pyarrow.compute as pc
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    if isinstance(array.type, pa.BaseExtensionType):
        array = array.storage
    shape = [len(array)]
    while True:
        if array.null_count:
            row = int(np.flatnonzero(array.is_null().to_numpy(zero_copy_only=False))[0])
            each = max(1, int(np.prod(shape[1:])))
            raise DataError(file, key, f"no value in row {start + row // each}")
        if not hasattr(array, "flatten") or not hasattr(array.type, "value_type"):
            break
        sizes = pc.list_value_length(array).to_numpy(zero_copy_only=False)
        if len(wrong := np.flatnonzero(sizes != sizes[0])):
            row = start + int(wrong[0]) // max(1, int(np.prod(shape[1:])))
            message = f"{sizes[wrong[0]]} numbers in row {row}; valid: {sizes[0]}, as before"
            raise DataError(file, key, message)
        shape.append(int(sizes[0]))
        array = array.flatten()
    # A copy: pyarrow's memory is read only, and the file's other episodes lie beside it.
    return array.to_numpy(zero_copy_only=False).reshape(shape).copy()


def _check_indices(
    layout: _Layout, file: Path, arrays: Mapping[str, np.ndarray], rows: _Rows, number: int
) -> None:
    """Compares the indices of an episode's rows with where it is said to lie."""
    frames = np.arange(rows.count)
    valid = {
        "episode_index": np.full(rows.count, number),
        "frame_index": frames,
        "index": frames + rows.index,
    }
    for key, expected in valid.items():
        if key not in arrays:
            raise DataError(file, key, "missing; valid: a number for each row")
        found = _one_number(file, key, arrays[key], rows.start)
        if len(wrong := np.flatnonzero(found != expected)):
            message = (
                f"{found[wrong[0]]} in row {rows.start + wrong[0]}; valid: {expected[wrong[0]]}"
            )
            raise DataError(file, key, message)
    fps = layout.info.get("fps")
    if "timestamp" in arrays and isinstance(fps, int | float) and 0 < fps < float("inf"):
        times = _one_number(file, "timestamp", arrays["timestamp"], rows.start)
        off = np.abs((times.astype(np.float64) - times[0]) * fps - frames)
        if len(wrong := np.flatnonzero(~(off <= _SLACK * (1 + frames)))):
            message = f"{times[wrong[0]]} in row {rows.start + wrong[0]} does not fit {fps} steps"
            raise DataError(file, "timestamp", f"{message} a second; valid: evenly spaced")


def _one_number(file: Path, key: str, array: np.ndarray, start: int) -> np.ndarray:
    if array.shape[1:] not in ((), (1,)):
        message = f"{array.shape[1:]} numbers in row {start}; valid: one for each row"
        raise DataError(file, key, message)
    return array.reshape(-1)


def _flags(file: Path, key: str, array: np.ndarray, start: int) -> np.ndarray:
    if len(wrong := np.flatnonzero((array != 0) & (array != 1))):
        message = f"{array[wrong[0]]} in row {start + wrong[0]}; valid: 0 or 1"
        raise DataError(file, key, message)
    return array.astype(bool)


def _column(array: np.ndarray) -> np.ndarray:
    return array[:, None] if array.ndim == 1 else array


def _parts(layout: _Layout, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parts of the observation: a column each, or as the features name its numbers."""
    parts: dict[str, np.ndarray] = {}
    for key, array in arrays.items():
        if not key.startswith("observation."):
            continue
        feature = layout.info["features"].get(key)
        names: Any = feature.get("names") if isinstance(feature, dict) else None
        whole = _column(array)
        split = _split(names) if whole.ndim == 2 else {}
        if sum(len(columns) for columns in split.values()) != whole.shape[1]:
            split = {}
        if not split or set(split) & set(parts):
            parts[key.removeprefix("observation.")] = whole
            continue
        for part, columns in split.items():
            scalar = names[columns[0]] == part
            parts[part] = whole[:, columns[0]] if scalar else whole[:, columns]
    return parts


def _split(names: Any) -> dict[str, list[int]]:
    """Columns by part, where each is named ``<part>.<i>``, i from 0, or after a part of one."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return {}
    parts: dict[str, list[int]] = {}
    numbered = False
    for column, name in enumerate(names):
        found = re.fullmatch(r"(.+)\.(0|[1-9]\d*)", name)
        part, position = (found[1], int(found[2])) if found else (name, 0)
        if position != len(parts.get(part, ())) or (not found and "." in name):
            return {}
        parts.setdefault(part, []).append(column)
        numbered |= found is not None
    return parts if numbered else {}
