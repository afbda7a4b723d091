"""Checks of what a checkpoint's metadata contain."""

from __future__ import annotations

import re
import reprlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_bmrl.envs.transforms import ObservationStatistics
from torchrl_bmrl.errors import BMRLError, CheckpointError


def is_number(x: Any) -> bool:
    """Whether it is a finite number."""
    return isinstance(x, float | int) and abs(x) <= sys.float_info.max


def is_name(x: Any) -> bool:
    """Whether it is a text that a page can show."""
    return isinstance(x, str) and 0 < len(x) <= 200


def is_task_name(x: Any) -> bool:
    """Whether a task's name can be part of a file name."""
    return is_name(x) and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", x) is not None


def are_statistics(x: Any, size: int) -> bool:
    """Whether they are mean and scale of an observation of this size."""
    try:
        return len(ObservationStatistics.from_lists(x).loc) == size
    except BMRLError:
        return False


def check_statistics(
    path: Path, metadata: Mapping[str, Any], statistics: ObservationStatistics
) -> None:
    """Checks that a policy was trained on observations that are normalised as here.

    Args:
        path: its checkpoint, for the message.
        metadata: of the checkpoint.
        statistics: of the normalisation.

    Raises:
        CheckpointError: if it was trained with other statistics, or does not tell them.
    """
    own: Any = metadata.get("statistics")
    if not are_statistics(own, len(statistics.loc)):
        raise CheckpointError(path, f"statistics are {reprlib.repr(own)}; valid: loc and scale")
    if not statistics.close_to(ObservationStatistics.from_lists(own)):
        raise CheckpointError(
            path,
            "trained on observations that other statistics normalised than data/statistics.json; "
            "valid: a policy of these demonstrations, or another run_dir",
        )
