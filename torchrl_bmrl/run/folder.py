"""Run folders: what a run was told, on what it ran, and whether it may go on."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import math
import os
import platform
import re
import subprocess
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from weakref import WeakSet

import torch

from torchrl_bmrl import __version__
from torchrl_bmrl.errors import ConfigError, DataError, UnknownNameError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import link_or_copy, read_json, write_atomic

with needs("recipes"):
    import yaml

log = logging.getLogger(__name__)

FREE_TO_CHANGE = (
    "run_dir",
    "base",
    "preset",
    "ablation",
    "workers",
    "only",
    "stepper",
    "logger",
    "verbose",
    "checkpoint_interval",
    "keep_checkpoints",
    "imitate",
    "interpolation",
    "latent_sac",
    "fqe",
    "baselines",
)
"""Settings that do not change a run's result, and so may differ when it goes on.

Studies of a finished run are among them; each is held to its own settings by its own folder.
Presets and ablations are names of settings, which are compared themselves.
"""
_START = ("seed", "tasks", "collect")
ADOPTED: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("data/[!.]*.*", _START),
    ("bcq/*/*.*", (*_START, "bcq")),
    ("distill/*.*", (*_START, "bcq", "distill")),
    ("evaluation/*-expert.csv", (*_START, "evaluate")),
    ("evaluation/*-bcq.csv", (*_START, "bcq", "evaluate")),
)
"""What a run takes from its base: files, and the settings that decide them."""
LOGGERS = ("csv", "wandb", "tensorboard", "none")
PACKAGES = ("torchrl", "tensordict", "robosuite", "mujoco", "gymnasium", "numpy", "h5py")


def open_run(run_dir: Path, settings: Mapping[str, Any]) -> None:
    """Creates a run folder, or checks that an existing one was told the same.

    Writes ``config.yaml`` (everything that decides the run) and ``versions.json``. With ``base``
    among the settings, another run's folder, a new run begins with those files of it that it would
    only make again (:data:`ADOPTED`). Of several processes that create a folder at once, one does
    and the others are checked.

    Args:
        run_dir: the folder.
        settings: the resolved configuration.

    Raises:
        ConfigError: if the folder holds a run with other settings; the first that differs is named.
        DataError: if ``base`` is not a run's folder.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> open_run(folder, {"seed": 0})
        >>> open_run(folder, {"seed": 1})
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: ...: seed is 1 here and 0 in the folder's run; ...
    """
    path = run_dir / "config.yaml"
    if not path.exists():
        base = Path(settings["base"]) if settings.get("base") else None
        theirs = read_settings(base) if base else {}
        # Torch itself names its build (2.14.1+cu130); its package's metadata may not.
        versions = {"torch": str(torch.__version__)} | {name: _version(name) for name in PACKAGES}
        versions |= {"torchrl_bmrl": __version__, "python": platform.python_version()}
        if commit := _commit():
            versions["commit"] = commit
        write_atomic(run_dir / "versions.json", json.dumps(versions, indent=2) + "\n")
        write_atomic(path, yaml.safe_dump(dict(settings), sort_keys=False), replace=False)
        if base:  # killed from here on, the run makes what is not there yet
            patterns = [
                pattern
                for pattern, keys in ADOPTED
                if all(theirs.get(key) == settings.get(key) for key in keys)
            ]
            _adopt(run_dir, base, patterns)
    before, now = deciding(read_settings(run_dir)), deciding(settings)
    for key in sorted(before | now):
        if before.get(key) != now.get(key):
            raise ConfigError(
                f"{run_dir}: {key} is {now.get(key)} here and {before.get(key)} in the folder's "
                "run; give the same settings to go on, or another run_dir"
            )


def deciding(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that decide a run's result, by their dotted names.

    Example:
        >>> deciding({"seed": 0, "workers": 2, "bcq": {"lr": 0.001}})
        {'seed': 0, 'bcq.lr': 0.001}
    """
    return dict(flat({key: x for key, x in settings.items() if key not in FREE_TO_CHANGE}))


def _adopt(run_dir: Path, base: Path, patterns: Iterable[str]) -> None:
    """Takes another run's files."""
    for pattern in patterns:
        for source in base.glob(pattern):
            target = run_dir / source.relative_to(base)
            if target.exists():  # another process has made it already
                continue
            link_or_copy(source, target)


def read_settings(run_dir: Path) -> dict[str, Any]:
    """The configuration of a run folder.

    Args:
        run_dir: the folder.

    Returns:
        the settings as :func:`open_run` was given them, nested as they were.

    Raises:
        DataError: if there is none, or it is not YAML.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> open_run(folder, {"seed": 0, "bcq": {"lr": 0.001}})
        >>> read_settings(folder)
        {'seed': 0, 'bcq': {'lr': 0.001}}
    """
    path = run_dir / "config.yaml"
    if not path.is_file():
        raise DataError(path, None, "no such file; valid: the folder of a run")
    try:
        settings = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(path, None, f"not YAML ({error})") from error
    if not isinstance(settings, dict):
        raise DataError(path, None, "not a mapping of settings")
    return settings


class _Loader(yaml.SafeLoader):
    """Without references: a few lines of them grow to more than any memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("a reference; valid: settings written out")
        return super().compose_node(parent, index)


def read_versions(run_dir: Path) -> dict[str, str]:
    """Versions of what the run uses.

    Args:
        run_dir: the folder.

    Returns:
        versions by package, and of ``python``; ``"None"`` for a package that was not installed.

    Raises:
        DataError: if the folder has no ``versions.json``, or it is damaged.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> open_run(folder, {"seed": 0})
        >>> read_versions(folder)["torchrl_bmrl"] == __version__
        True
    """
    path = run_dir / "versions.json"
    versions = read_json(path, "the versions of a run")
    if not isinstance(versions, dict):
        raise DataError(path, None, f"a {type(versions).__name__}; valid: versions by name")
    return {name: str(version) for name, version in versions.items()}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the sources, with a ``+`` where they were changed since; ``None`` outside git."""
    source = Path(__file__)
    git = ["git", "-C", str(source.parent)]
    try:
        # An installed copy may lie within another project's repository, which ignores it.
        subprocess.run(
            [*git, "ls-files", "--error-unmatch", source.name], capture_output=True, check=True
        )
        command = [*git, "describe", "--always", "--exclude=*", "--dirty=+"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Settings by their dotted names.

    Example:
        >>> dict(flat({"seed": 0, "bcq": {"lr": 0.001}}))
        {'seed': 0, 'bcq.lr': 0.001}
    """
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


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
