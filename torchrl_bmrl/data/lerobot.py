"""Writes data sets in LeRobot's v3.0 layout.

Layout of a data set's folder::

    data/chunk-000/file-000.parquet            a row for each step, a row group for each episode
    meta/info.json                             fps, totals, features with shapes and names
    meta/stats.json                            of each feature over all steps
    meta/tasks.parquet                         the task's text and its index
    meta/episodes/chunk-000/file-000.parquet   a row for each episode, its statistics among them

The layout loses the observation after the last step, and the precision of float64: only indices and
flags are not float32. Minari's layout loses neither. The module to read it is
:mod:`torchrl_bmrl.data.lerobot_reader`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, join_observations
from torchrl_bmrl.data.schema import check_episode, check_fps, layout_of
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import new_folder

FILE_SIZE = 100
"""Size of a data file [MiB] after which the next one begins, as in LeRobot."""
FILES_PER_CHUNK = 1000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)


def write_episodes(
    path: str | os.PathLike[str],
    episodes: Iterable[Episode],
    *,
    fps: float,
    task: str,
) -> None:
    """Writes a whole data set, or nothing.

    ``LeRobotDataset(repo_id, root=path)`` reads it. The columns, each with T rows for an episode:
    ``observation.state`` (the parts in their order, one after the other), ``action``,
    ``next.reward``, ``next.done`` (the last step), ``next.terminated``, ``next.success`` where
    there are ``successes``, ``timestamp`` [s] and the indices. Other extras and the attributes
    are not written.

    Args:
        path: the new folder.
        episodes: of equal parts, shapes and dtypes, consumed one at a time.
        fps: steps per second [Hz].
        task: what the robot does, in words.

    Raises:
        DataError: if the folder exists, without episodes, and, naming episode, key and row, for an
            episode that cannot be stored. Images are not exported.
        ConfigError: if ``fps`` is not positive or ``task`` is empty.
        MissingExtraError: if pyarrow is not installed.
    """
    check_fps(fps)
    if not task:
        raise ConfigError("task is empty; valid: what the robot does, in words")
    with needs("data"):  # before anything is written
        import pyarrow.parquet  # noqa: F401
    path = Path(path)
    with new_folder(path) as folder:
        rows: list[dict[str, Any]] = []
        features: dict[str, Any] = {}
        layout = None
        with _Frames(folder) as frames:
            for i, episode in enumerate(episodes):
                name = f"episode_{i}"
                check_episode(path, name, episode, layout=layout, bounds=None)
                layout = layout or layout_of(episode)
                start = rows[-1]["dataset_to_index"] if rows else 0
                columns = _columns(path, name, episode)
                columns |= _indices(len(episode), fps=fps, number=i, start=start)
                features = features or _features(episode, columns)
                rows.append(_row(columns, task, i, start, *frames.write(columns)))
        if not rows:
            raise DataError(path, None, "no episodes; valid: at least one")
        _write_meta(folder / "meta", rows, _total(folder / "data", features), task)
        info = {
            "codebase_version": "v3.0",
            "robot_type": None,
            "total_episodes": len(rows),
            "total_frames": rows[-1]["dataset_to_index"],
            "total_tasks": 1,
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": FILE_SIZE,
            "video_files_size_in_mb": 200,
            "fps": int(fps) if float(fps).is_integer() else fps,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": f"data/{_FILE}",
            "video_path": None,
            "features": features,
        }
        _write_json(folder / "meta" / "info.json", info)


def describe_losses(
    *, extras: Iterable[str], attributes: Iterable[str], rounded: bool, whole_numbers: bool
) -> Iterator[str]:
    """Describes what :func:`write_episodes` cannot store.

    Args:
        extras: names of the episodes' extras.
        attributes: names of their attributes.
        rounded: whether some numbers have more than 32 bits.
        whole_numbers: whether actions, rewards or observations are integers.
    """
    dropped = [*(name for name in extras if name != "successes"), *attributes]
    named = f"; {', '.join(dropped)}" if dropped else ""
    yield f"left out: the observation after the last step of each episode{named}"
    if rounded:
        yield "numbers of 64 bits are rounded to float32"
    if whole_numbers:
        yield "whole numbers become float32"


def _columns(path: Path, name: str, episode: Episode) -> dict[str, np.ndarray]:
    """Columns of an episode's data, ``(T, n)``, or ``(T,)`` if n is 1."""
    join_observations(path, name, episode)
    for key, array in {"actions": episode.actions, **episode.observations}.items():
        if array.ndim > 2:
            key = key if key == "actions" else f"obs/{key}"
            message = f"shape {array.shape}: images are not exported; valid: one number or one row"
            raise DataError(path, f"{name}/{key}", f"{message} of them a step; choose other parts")
    steps = len(episode)
    parts = [part.reshape(steps, -1) for part in episode.observations.values()]
    columns = {
        "observation.state": np.concatenate(parts, axis=1).astype(np.float32),
        "action": episode.actions.reshape(steps, -1).astype(np.float32),
        "next.reward": episode.rewards.astype(np.float32),
        "next.done": np.arange(steps) == steps - 1,
        # LeRobot loads it, too. next.done does not tell whether a value follows.
        "next.terminated": episode.terminated.astype(bool),
    }
    if "successes" in episode.extras:
        columns["next.success"] = episode.extras["successes"].astype(bool)
    for key, column in columns.items():
        if not (finite := np.isfinite(column)).all():
            row = int(np.argwhere(~finite)[0][0])
            raise DataError(path, f"{name}/{key}", f"row {row} is too large for float32")
    # LeRobot has no lists of one number.
    return {key: x[:, 0] if x.shape[1:] == (1,) else x for key, x in columns.items()}


def _indices(steps: int, *, fps: float, number: int, start: int) -> dict[str, np.ndarray]:
    frames = np.arange(steps)
    return {
        "timestamp": (frames / fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(steps, number),
        "index": frames + start,
        "task_index": np.zeros(steps, dtype=np.int64),
    }


def _features(episode: Episode, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    names = {
        "observation.state": _names(episode.observations),
        "action": _names({"action": episode.actions}),
    }
    return {
        key: {
            "dtype": str(array.dtype),
            "shape": list(array.shape[1:]) or [1],
            "names": names.get(key),
        }
        for key, array in columns.items()
    }


def _names(parts: Mapping[str, np.ndarray]) -> list[str]:
    """A name for each number, such as ``"goal_pos.2"``."""
    return [
        name if part.ndim == 1 else f"{name}.{i}"
        for name, part in parts.items()
        for i in range(part[0].size)
    ]


class _Frames:
    """Writer of the data files, which starts a new one at LeRobot's size limit."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.number = -1
        self.writer: Any = None
        self.path: Path

    def __enter__(self) -> _Frames:
        return self

    def __exit__(self, *error: object) -> None:
        if self.writer is not None:
            self.writer.close()

    def write(self, columns: Mapping[str, np.ndarray]) -> tuple[int, int]:
        """Writes an episode; returns the indices of its chunk and file."""
        with needs("data"):
            from pyarrow.parquet import ParquetWriter

        table = _table(columns)
        if self.writer is None or self.path.stat().st_size >= FILE_SIZE * 2**20:
            self.__exit__()
            self.number += 1
            chunk, file = divmod(self.number, FILES_PER_CHUNK)
            self.path = self.folder / "data" / _FILE.format(chunk_index=chunk, file_index=file)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = ParquetWriter(self.path, table.schema, write_page_checksum=True)
        self.writer.write_table(table)
        return divmod(self.number, FILES_PER_CHUNK)


def _table(columns: Mapping[str, np.ndarray]) -> Any:
    with needs("data"):
        import pyarrow as pa

    arrays = {}
    for key, array in columns.items():
        flat = pa.array(array.reshape(-1))
        lists = array.ndim > 1
        arrays[key] = pa.FixedSizeListArray.from_arrays(flat, array.shape[1]) if lists else flat
    return pa.table(arrays)


def _row(
    columns: Mapping[str, np.ndarray], task: str, number: int, start: int, chunk: int, file: int
) -> dict[str, Any]:
    steps = len(columns["index"])
    return {
        "episode_index": number,
        "tasks": [task],
        "length": steps,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": start,
        "dataset_to_index": start + steps,
        **{
            f"stats/{key}/{name}": value.tolist()
            for key, array in columns.items()
            for name, value in _statistics(array).items()
        },
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _statistics(array: np.ndarray) -> dict[str, np.ndarray]:
    """LeRobot's statistics, each ``(n,)``, with exact quantiles instead of histograms."""
    rows = array.reshape(len(array), -1)
    exact = rows.astype(np.float64)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        "count": np.array([len(rows)]),
        **{f"q{round(100 * q):02d}": np.quantile(exact, q, axis=0) for q in _QUANTILES},
    }


def _total(data: Path, features: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Statistics over all steps. LeRobot's own quantiles are means of those of its episodes."""
    with needs("data"):
        import pyarrow as pa
        from pyarrow.parquet import read_table

    files = sorted(data.rglob("*.parquet"))
    total = {}
    for feature in features:
        column = pa.concat_tables([read_table(file, columns=[feature]) for file in files])[feature]
        flat = column.combine_chunks()
        flat = flat.flatten() if pa.types.is_fixed_size_list(flat.type) else flat
        rows = flat.to_numpy(zero_copy_only=False).reshape(len(column), -1)
        # One number at a time: sorting takes several times the memory of what is sorted.
        each = [_statistics(rows[:, i]) for i in range(rows.shape[1])]
        total[feature] = {
            name: np.concatenate([x[name] for x in each]).tolist() for name in each[0]
        } | {"count": [len(rows)]}
    return total


def _write_meta(
    meta: Path, rows: list[dict[str, Any]], stats: dict[str, dict[str, Any]], task: str
) -> None:
    with needs("data"):
        import pyarrow as pa
        from pyarrow.parquet import write_table

    path = meta / "episodes" / _FILE.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    write_table(pa.Table.from_pylist(rows), path, write_page_checksum=True)
    _write_json(meta / "stats.json", stats)
    # LeRobot reads the table with pandas, with the text as the index of the data frame.
    types = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {
                "name": name,
                "field_name": name,
                "pandas_type": kind,
                "numpy_type": dtype,
                "metadata": None,
            }
            for name, (kind, dtype) in types.items()
        ],
    }
    table = pa.table({"task_index": [0], "task": [task]})
    write_table(
        table.replace_schema_metadata({"pandas": json.dumps(pandas)}), meta / "tasks.parquet"
    )


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")
