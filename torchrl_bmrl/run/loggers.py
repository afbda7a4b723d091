"""TorchRL's loggers for a run folder; a logger that fails never ends a run."""

from __future__ import annotations

import logging
import math
import os
import re
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from weakref import WeakSet

from torchrl_bmrl.errors import UnknownNameError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import write_atomic

log = logging.getLogger(__name__)

LOGGERS = ("csv", "wandb", "tensorboard", "none")
INIT_TIMEOUT = 15.0
"""Longest wait for the server of Weights & Biases [s]; wandb's own default is 90."""


def make_logger(kind: str, run_dir: Path, name: str, step: int = 0) -> Any:
    """Returns one of TorchRL's loggers, which writes under ``run_dir/logs``.

    If a logger cannot be created, for example without a connection to its server, a warning is
    logged and the CSV logger is used instead. This process then does not try again for that folder.

    Args:
        kind: ``"csv"``, ``"wandb"``, ``"tensorboard"`` or ``"none"``.
        run_dir: the run folder.
        name: name of the experiment, such as ``"bcq_lift"``.
        step: step that training continues from; later CSV rows are removed.

    Returns:
        a :class:`torchrl.record.loggers.Logger`, or ``None`` for ``"none"``. Weights & Biases is
        offline if no account is configured and ``WANDB_MODE`` is not set. There, every name in a
        run folder has its own run, which a continued run appends to.

    Raises:
        UnknownNameError: for another kind.

    Example:
        >>> import tempfile
        >>> logger = make_logger("csv", Path(tempfile.mkdtemp()), "bcq_lift")
        >>> log_metrics(logger, {"loss_qvalue": 0.5}, step=100)
        >>> make_logger("none", Path("runs/a"), "bcq_lift") is None
        True
    """
    if kind not in LOGGERS:
        raise UnknownNameError("logger", kind, LOGGERS)
    if kind == "none":
        return None
    from torchrl.record.loggers import get_logger

    folder = run_dir / "logs"
    if kind != "csv" and (kind, folder) not in _unavailable:
        try:
            options = {"wandb_kwargs": _wandb_options(run_dir, name)} if kind == "wandb" else {}
            return get_logger(kind, str(folder), name, **options)
        except Exception as error:  # servers and their libraries raise errors of any type
            _unavailable.add((kind, folder))
            reason = _first_line(error)
            log.warning(
                f"{name}: {kind} is not available ({reason}); metrics go to CSV files in {folder}"
            )
    for path in (folder / name / "scalars").glob("*.csv"):
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        rows = text.splitlines(keepends=True)
        kept = [row for row in rows if row.endswith("\n") and _step(row) <= step]
        if kept != rows or path.is_symlink():  # rows are appended, here and not to another file
            write_atomic(path, "".join(kept))
    return get_logger("csv", str(folder), name)


def _wandb_options(run_dir: Path, name: str) -> dict[str, Any]:
    with needs("recipes"):
        import wandb

    mode = os.environ.get("WANDB_MODE") or ("online" if wandb.api.api_key else "offline")
    return {
        "mode": mode,
        "project": "torchrl_bmrl",
        "dir": str(run_dir),
        "id": _wandb_id(run_dir / "logs" / name / "wandb_id"),
        # By default wandb uses the process's first run for every logger.
        "reinit": "create_new",
        "settings": {} if "WANDB_INIT_TIMEOUT" in os.environ else {"init_timeout": INIT_TIMEOUT},
    }


def _wandb_id(path: Path) -> str:
    """Returns the id of a logger's wandb run, which is stored beside its metrics."""
    known = path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""
    if not re.fullmatch("[0-9a-f]{16}", known):  # wandb names a folder after it
        known = uuid.uuid4().hex[:16]
        write_atomic(path, known + "\n")
    return known


def _step(row: str) -> float:
    """Returns the step of a row of TorchRL's CSV logger; infinity for a damaged row."""
    number = row.partition(",")[0]
    return int(number) if number.isdecimal() else math.inf


def log_metrics(logger: Any, metrics: Mapping[str, Any], step: int) -> None:
    """Logs scalars under their names.

    A logger that fails causes one warning and is not used again.

    Args:
        logger: from :func:`make_logger`; ``None`` logs nothing.
        metrics: numbers, or tensors of one number, by name.
        step: step of the metrics.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> logger = make_logger("csv", folder, "bcq_lift")
        >>> log_metrics(logger, {"loss_qvalue": 0.5}, step=100)
        >>> [file.name for file in folder.rglob("*.csv")]
        ['loss_qvalue.csv']
    """
    if logger is None or logger in _lost:
        return
    try:
        for name, value in metrics.items():
            logger.log_scalar(name, float(value), step=step)
    except Exception as error:
        _lost.add(logger)
        log.warning(f"metrics from step {step} on are not logged ({_first_line(error)})")


def close_logger(logger: Any) -> None:
    """Closes a logger: writes its last metrics, and finishes a run of Weights & Biases.

    If this fails, a warning is logged.

    Args:
        logger: from :func:`make_logger`, or ``None``.

    Example:
        >>> import tempfile
        >>> logger = make_logger("csv", Path(tempfile.mkdtemp()), "bcq_lift")
        >>> close_logger(logger)
    """
    if logger is None:
        return
    try:
        logger.close()
    except Exception as error:
        log.warning(f"the last metrics may be missing ({_first_line(error)})")


_unavailable: set[tuple[str, Path]] = set()
"""Kinds of loggers that could not be made, with their folders: each attempt takes its time."""
_lost: WeakSet[Any] = WeakSet()
"""Loggers that failed."""


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__
