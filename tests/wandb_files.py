"""What an offline run of Weights & Biases wrote, read back without its server."""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

BLOCK = 32768  # of LevelDB's log format, after which a file's records are framed


def offline(patch: pytest.MonkeyPatch, home: Path) -> dict[str, str]:
    """Has wandb know no account and touch nothing but ``home``, here and in other processes."""
    for name in [name for name in os.environ if name.startswith("WANDB_")] + ["NETRC"]:
        patch.delenv(name, raising=False)
    home.mkdir()
    env = {name: str(home) for name in ("HOME", *(f"WANDB_{x}_DIR" for x in NAMES))}
    env["WANDB_SILENT"] = "true"
    for name, value in env.items():
        patch.setenv(name, value)
    return env


NAMES = ("CACHE", "CONFIG", "DATA")


def records(path: Path) -> Iterator[bytes]:
    """Records of a ``.wandb`` file, up to one that is not yet written whole."""
    data, position, part = path.read_bytes(), 7, b""
    assert data[:4] in (b"", b":W&B")
    while position + 7 <= len(data):
        left = BLOCK - position % BLOCK
        if left < 7:
            position += left
            continue
        _, size, kind = struct.unpack("<IHB", data[position : position + 7])
        if position + 7 + size > len(data):
            return
        part += data[position + 7 : position + 7 + size]
        position += 7 + size
        if kind in (1, 4):  # a whole record, or the last part of one
            yield part
            part = b""


def read_runs(run_dir: Path, patience: float = 30.0) -> list[dict]:
    """Of each file, in the order of their starts: name, id, rows logged, and whether it ended.

    wandb's ``finish()`` returns before its other process has written the records, so that files
    without an end are read again for ``patience`` [s].
    """
    deadline = time.monotonic() + patience
    while True:
        runs = [_read_run(path) for path in run_dir.glob("wandb/offline-run-*/*.wandb")]
        if all(run["ended"] for run in runs) or time.monotonic() > deadline:
            return sorted(runs, key=lambda run: run["at"])
        time.sleep(0.05)


def _read_run(path: Path) -> dict:
    from wandb.proto import wandb_internal_pb2

    run: dict = {"rows": [], "ended": False, "at": 0}
    for text in records(path):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(text)
        kind = record.WhichOneof("record_type")
        if kind == "run":
            started = record.run.start_time.ToNanoseconds()
            run |= {"name": record.run.display_name, "id": record.run.run_id, "at": started}
        elif kind == "history":
            items = record.history.item
            row = {x.key or "/".join(x.nested_key): json.loads(x.value_json) for x in items}
            run["rows"].append({key: x for key, x in row.items() if key[0] != "_"})
        elif kind == "exit":
            run["ended"] = True
    return run
