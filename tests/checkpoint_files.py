"""Where checkpoint tests write, what they write, and a comparison of states to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor, nn

META = {"kind": "example", "epochs": 3, "tasks": ["reach", "σ"], "loss": {"clip": None, "lr": 1e-5}}


def checkpoint_path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "checkpoint.safetensors"


def same(a: Any, b: Any) -> bool:
    """Equality of nested states, tensors bit by bit with their dtype; tuples count as lists."""
    if isinstance(a, Tensor):
        return (
            isinstance(b, Tensor)
            and a.dtype == b.dtype
            and a.shape == b.shape
            and a.contiguous().numpy().tobytes() == b.contiguous().numpy().tobytes()
        )
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def network(width: int = 4) -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, width), nn.BatchNorm1d(width), nn.Linear(width, 1))
