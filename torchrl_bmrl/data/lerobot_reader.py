"""Reads LeRobot data sets of the layouts v2.0, v2.1 and v3.0.

:mod:`torchrl_bmrl.data.lerobot` describes and writes v3.0. The older layouts differ in::

    data/chunk-000/episode_000000.parquet      a file for each episode
    meta/episodes.jsonl                        a line for each episode
    meta/tasks.jsonl                           a line for each task

Pages of parquet files may have checksums, as those written by this library do; then flipped bits
are detected. Images and videos are not read. The layout has no observation after the last step.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.arrays import as_column, as_flags, check_finite
from torchrl_bmrl.data.episodes import LazyEpisodes
from torchrl_bmrl.data.lerobot_meta import Layout, Rows, open_parquet
from torchrl_bmrl.data.raw import Opened, RawEpisode
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs

_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_STEPS = ("next.reward", "next.done", "next.success", "next.terminated")
_SLACK = 1e-3
"""Tolerance of a timestamp, relative to the time since the first one (they are float32)."""


@contextmanager
def open_data(path: str | os.PathLike[str]) -> Iterator[Opened]:
    """Opens a data set; each episode is read on access.

    Every column ``observation.<part>`` of numbers is a part of the observation. If the features
    name each number ``<part>.<i>``, as this library writes ``observation.state``, those are the
    parts. ``action``, ``next.reward``, ``next.done``, ``next.terminated`` and ``next.success``
    become actions, rewards, dones, terminations and the extra ``successes``; other columns of
    numbers are extras, and the task's text is the attribute ``task``. Images, videos and texts are
    not read, but listed in ``left_alone``.

    Args:
        path: the data set's folder, which contains ``meta/info.json``.

    Yields:
        the episodes as ``episode_0``, ``episode_1``, ...; the metadata ``dataset_id``, ``fps``,
        ``robot_type`` and, if all episodes have the same, ``task``; and oddities.

    Raises:
        DataError: naming file, column and row, for a missing or damaged file, a git-LFS pointer, an
            unknown version of the layout, and indices that contradict each other. Faults of one
            episode are raised when it is read.
        MissingExtraError: if pyarrow is not installed.
    """
    layout = Layout.of(path)
    tables = _Tables(layout)
    metadata = {"dataset_id": layout.path.resolve().name, "fps": float(layout.info["fps"])}
    if isinstance(robot := layout.info.get("robot_type"), str):
        metadata["robot_type"] = robot
    tasks = {rows.task for rows in layout.episodes.values()}
    if len(tasks) == 1 and (task := tasks.pop()):
        metadata["task"] = task

    def read(name: str) -> RawEpisode:
        return _read_episode(layout, name, tables)

    yield Opened(
        episodes=LazyEpisodes(layout.episodes, read),
        metadata=metadata,
        oddities=list(_oddities(layout)),
    )


def _oddities(layout: Layout) -> Iterator[str]:
    steps = sum(rows.count for rows in layout.episodes.values())
    for key, found in (("total_episodes", len(layout.episodes)), ("total_frames", steps)):
        said = layout.info.get(key)
        if said is not None and said != found:
            yield f"meta/info.json: {key} is {said}, but there are {found}"
    tasks = sorted({str(rows.task) for rows in layout.episodes.values() if rows.task})
    if len(tasks) > 1:
        more = ", ..." if len(tasks) > 3 else ""
        yield f"{len(tasks)} tasks are read as one: {', '.join(map(repr, tasks[:3]))}{more}"
    videos = [
        key
        for key, feature in layout.info["features"].items()
        if isinstance(feature, dict) and feature.get("dtype") in ("video", "image")
    ]
    if videos:
        yield f"pictures are not read: {', '.join(videos)}"


# -- data ------------------------------------------------------------------------------------------


class _Tables:
    """Cache of one data file's columns of numbers, because neighbouring episodes share a file."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.name: str | None = None
        self.table: Any = None
        self.left_alone: list[str] = []

    def read(self, name: str) -> Any:
        """Reads the columns of numbers of a data file."""
        if name != self.name:
            with open_parquet(self.layout.path / name) as parquet:
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
                raise DataError(file, key, "missing, but meta/info.json lists it")


def _holds_numbers(kind: Any) -> bool:
    with needs("data"):
        import pyarrow as pa
    # The package datasets registers its own type for arrays of several dimensions.
    kind = kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind
    while (
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    ):
        kind = kind.value_type
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _read_episode(layout: Layout, name: str, tables: _Tables) -> RawEpisode:
    rows = layout.episodes[name]
    file = layout.path / rows.file
    table = tables.read(rows.file)
    part = table.slice(rows.start, rows.count)
    arrays = {key: _array(file, key, part[key], rows.start) for key in part.column_names}
    number = int(name.rpartition("_")[2])
    _check_indices(layout, file, arrays, rows, number)
    if "action" not in arrays:
        raise DataError(file, "action", "missing; valid: numbers, a row for each step")
    steps = {key: as_column(file, key, arrays[key]) for key in _STEPS if key in arrays}
    for key, array in arrays.items():
        if key.startswith("observation."):
            check_finite(file, key, array, rows.start)
    observations = _parts(layout, arrays)
    extras = {
        key: array
        for key, array in arrays.items()
        if key not in ("action", *_INDICES, *_STEPS) and not key.startswith("observation.")
    }
    flags = {
        key: as_flags(file, key, steps[key], rows.start)
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
    """A column of numbers, or of lists of equal lengths, as an array ``(T, ...)``."""
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
    # A copy: pyarrow's memory is read-only and shared with the file's other episodes.
    return array.to_numpy(zero_copy_only=False).reshape(shape).copy()


def _check_indices(
    layout: Layout, file: Path, arrays: Mapping[str, np.ndarray], rows: Rows, number: int
) -> None:
    """Compares the indices of an episode's rows with its position in ``meta``."""
    frames = np.arange(rows.count)
    valid = {
        "episode_index": np.full(rows.count, number),
        "frame_index": frames,
        "index": frames + rows.index,
    }
    for key, expected in valid.items():
        if key not in arrays:
            raise DataError(file, key, "missing; valid: a number for each row")
        found = as_column(file, key, arrays[key])
        if len(wrong := np.flatnonzero(found != expected)):
            message = (
                f"{found[wrong[0]]} in row {rows.start + wrong[0]}; valid: {expected[wrong[0]]}"
            )
            raise DataError(file, key, message)
    fps = layout.info["fps"]
    if "timestamp" in arrays:
        times = as_column(file, "timestamp", arrays["timestamp"])
        off = np.abs((times.astype(np.float64) - times[0]) * fps - frames)
        if len(wrong := np.flatnonzero(~(off <= _SLACK * (1 + frames)))):
            message = f"{times[wrong[0]]} in row {rows.start + wrong[0]} does not match {fps} steps"
            raise DataError(file, "timestamp", f"{message} a second; valid: evenly spaced")


def _column(array: np.ndarray) -> np.ndarray:
    return array[:, None] if array.ndim == 1 else array


def _parts(layout: Layout, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parts of the observation: one for each column, or as the features name its numbers."""
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
    """Columns by part, if each is named ``<part>.<i>``, i from 0, or ``<part>`` if it is alone."""
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
