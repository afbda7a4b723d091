"""LeRobot data sets of three versions, written by hand from known columns."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from episode_files import readers
from file_edits import edit_json

from torchrl_bmrl.data.lerobot_reader import open_data

open_raw, read_metadata, find_oddities = readers(open_data)
LENGTHS, FPS = (4, 6, 5), 10
VERSIONS = ("v2.0", "v2.1", "v3.0")
Columns = dict[str, Any]
FIRST = {"v2.1": "data/chunk-000/episode_000000.parquet", "v3.0": "data/chunk-000/file-000.parquet"}
"""File of the first episode."""


def columns_of(i: int) -> Columns:
    """Columns of an episode; those with several numbers a row are lists."""
    rng, steps = np.random.default_rng(i), LENGTHS[i]
    frames, start = np.arange(steps), sum(LENGTHS[:i])
    return {
        "observation.state": rng.standard_normal((steps, 3)).astype("f4").tolist(),
        "observation.environment_state": rng.standard_normal((steps, 2)).astype("f4").tolist(),
        "observation.images.top": [{"bytes": b"png", "path": None}] * steps,
        "action": rng.uniform(-1, 1, (steps, 2)).astype("f4").tolist(),
        "next.reward": rng.random(steps).astype("f4"),
        "next.done": frames == steps - 1,
        "next.success": (frames == steps - 1) & (i != 1),
        "effort": rng.standard_normal((steps, 2, 2)).tolist(),
        "timestamp": (frames / FPS).astype("f4"),
        "frame_index": frames,
        "episode_index": np.full(steps, i),
        "index": start + frames,
        "task_index": np.full(steps, i % 2),
    }


def write(path: Path, version: str, episodes: list[Columns] | None = None) -> Path:
    """Writes a data set; one of v3.0 has the last episode in a second file."""
    episodes = [columns_of(i) for i in range(len(LENGTHS))] if episodes is None else episodes
    meta = path / "meta"
    meta.mkdir(parents=True)
    info = {
        "codebase_version": version,
        "fps": FPS,
        "total_episodes": len(episodes),
        "total_frames": sum(len(columns["index"]) for columns in episodes),
        "chunks_size": 2,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [3], "names": {"axes": ["x"]}},
            "observation.images.top": {"dtype": "image", "shape": [8, 8, 3], "names": None},
            "observation.images.wrist": {"dtype": "video", "shape": [8, 8, 3], "names": None},
        },
    }
    (meta / "info.json").write_text(json.dumps(info))
    rows, start = [], 0
    for i, columns in enumerate(episodes):
        steps = len(columns["index"])
        rows.append({"episode_index": i, "tasks": [f"task {i % 2}"], "length": steps})
        last = i == len(episodes) - 1
        rows[-1] |= {"data/chunk_index": 0, "data/file_index": int(last)}
        rows[-1] |= {"dataset_from_index": start, "dataset_to_index": start + steps}
        start += steps
    if version == "v3.0":
        for name, part in (("000", episodes[:-1]), ("001", episodes[-1:])):
            tables = [pa.table(columns) for columns in part]
            write_table(path / f"data/chunk-000/file-{name}.parquet", pa.concat_tables(tables))
        write_table(meta / "episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
    else:
        for i, columns in enumerate(episodes):
            name = f"data/chunk-{i // 2:03d}/episode_{i:06d}.parquet"
            write_table(path / name, pa.table(columns))
        lines = [{key: row[key] for key in ("episode_index", "tasks", "length")} for row in rows]
        (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def write_table(path: Path, table: Any) -> None:
    """Writes a parquet file with checksums and several groups of rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, row_group_size=3, write_page_checksum=True)


def edit_info(path: Path, **changes: Any) -> None:
    """Changes entries of the description; ``None`` removes an entry."""
    edit_json(path / "meta" / "info.json", **changes)


def edit_data(path: Path, name: str, edit: Callable[[pa.Table], pa.Table]) -> None:
    """Changes the table of a data file."""
    pq.write_table(edit(pq.read_table(path / name)), path / name)
