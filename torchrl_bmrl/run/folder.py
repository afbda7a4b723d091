"""Run folders: what a run was told, on what it ran, and whether it may go on."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_bmrl import __version__
from torchrl_bmrl.errors import ConfigError, DataError
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
    # Sections of studies, in the folders of earlier versions.
    "human",
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
    return read_yaml(path)


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a YAML file that holds a mapping.

    Args:
        path: the file.

    Raises:
        DataError: if the file is missing, not YAML, or not a mapping.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.yaml"
        >>> write_atomic(path, "seed: 1")
        >>> read_yaml(path)
        {'seed': 1}
    """
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError as error:
        raise DataError(path, None, "no such file") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(path, None, f"not YAML ({error})") from error
    if not isinstance(content, dict):
        raise DataError(path, None, f"holds a {type(content).__name__}; valid: a mapping")
    return content


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
    """Settings by their dotted names; a tuple becomes a list, as in YAML.

    Example:
        >>> dict(flat({"seed": 0, "bcq": {"lr": 0.001}}))
        {'seed': 0, 'bcq.lr': 0.001}
    """
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", list(value) if isinstance(value, tuple) else value
