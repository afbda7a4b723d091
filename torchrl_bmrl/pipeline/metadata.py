"""Checks of what a checkpoint's metadata contain."""

from __future__ import annotations

import math
import re
from typing import Any


def is_number(x: Any) -> bool:
    """Whether it is a finite number."""
    return isinstance(x, float | int) and math.isfinite(x)


def is_name(x: Any) -> bool:
    """Whether it is a text that a page can show."""
    return isinstance(x, str) and 0 < len(x) <= 200


def is_task_name(x: Any) -> bool:
    """Whether a task's name can be part of a file name."""
    return is_name(x) and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", x) is not None


def are_statistics(x: Any) -> bool:
    """Whether they are an observation's mean and scale."""
    if not isinstance(x, dict) or set(x) - {"parts"} != {"loc", "scale"}:
        return False
    parts = x.get("parts", [])
    if not isinstance(parts, list) or not all(map(is_name, parts)):
        return False
    lists = isinstance(x["loc"], list) and isinstance(x["scale"], list)
    return (
        lists
        and len(x["loc"]) == len(x["scale"])
        and all(map(is_number, [*x["loc"], *x["scale"]]))
        and all(scale > 0 for scale in x["scale"])
    )
