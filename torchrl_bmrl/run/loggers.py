"""TorchRL's loggers for a run folder: their failures never end a run."""

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


def make_logger(kind: str, run_dir: Path, name: str, step: int = 0) -> Any:
    """One of TorchRL's loggers, writing under ``run_dir/logs``.

    A logger that cannot be made, say because its server cannot be reached, is reported on stderr
    and replaced by the one that writes CSV files.

    Args:
        kind: ``"csv"``, ``"wandb"``, ``"tensorboard"`` or ``"none"``.
        run_dir: the run folder.
        name: of the experiment, such as ``"bcq_lift"``.
        step: that the run goes on from. CSV rows after it are dropped: they come again.

    Returns:
        a :class:`torchrl.record.loggers.Logger`, or ``None`` for ``"none"``. Weights & Biases runs
        offline where no account is configured, unless ``WANDB_MODE`` says otherwise. Every name of
        a run folder is a run of its own there, which a run that goes on continues.

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
    if kind != "csv":
        try:
            options = {"wandb_kwargs": _wandb_options(run_dir, name)} if kind == "wandb" else {}
            return get_logger(kind, str(folder), name, **options)
        except Exception as error:  # whatever a server or its library may come up with
            reason = _first_line(error)
            log.warning(f"{name}: no {kind} ({reason}); metrics go to CSV files in {folder}")
    for path in (folder / name / "scalars").glob("*.csv"):
        rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [row for row in rows if row.endswith("\n") and _step(row) <= step]
        if kept != rows:
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
        # Else wandb gives every logger of a process the run of the first one.
        "reinit": "create_new",
    }


def _wandb_id(path: Path) -> str:
    """Of the run that a logger began or goes on with; kept beside its metrics."""
    known = path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""
    if not re.fullmatch("[0-9a-f]{16}", known):  # wandb makes a folder of it
        known = uuid.uuid4().hex[:16]
        write_atomic(path, known + "\n")
    return known


def _step(row: str) -> float:
    """Of a row of TorchRL's CSV logger; that of a damaged one is beyond all others."""
    number = row.partition(",")[0]
    return int(number) if number.isdecimal() else math.inf


def log_metrics(logger: Any, metrics: Mapping[str, Any], step: int) -> None:
    """Logs scalars under their names; does nothing without a logger.

    A logger that fails is reported on stderr, once, and not used again.

    Args:
        logger: of :func:`make_logger`; ``None`` for none.
        metrics: numbers, or tensors of one number, by name.
        step: that they belong to.

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
        log.warning(f"metrics are logged no more, from step {step} on ({_first_line(error)})")


def close_logger(logger: Any) -> None:
    """Ends a logger: what it holds is written, and a run of Weights & Biases is finished.

    One that fails is reported on stderr; nothing depends on it.

    Args:
        logger: of :func:`make_logger`; ``None`` for none.

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
        log.warning(f"the end of the metrics may be missing ({_first_line(error)})")


_lost: WeakSet[Any] = WeakSet()
"""Loggers that failed."""


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__
