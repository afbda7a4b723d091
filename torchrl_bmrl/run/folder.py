"""Run folders: the settings and package versions of a run, and whether it may be continued."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchrl_bmrl import __version__
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import digest_of, link_or_copy, read_json, write_atomic

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
    "evaluate.reference",  # adds rows to results.csv and changes no other row
    # Sections of studies in folders of earlier versions.
    "human",
    "imitate",
    "interpolation",
    "latent_sac",
    "fqe",
    "baselines",
)
"""Settings that may change when a run is continued, since its results do not depend on them.

A study of a finished run compares its settings in its own folder. A preset or an ablation is a
name for settings that are compared themselves.
"""
_START = ("seed", "tasks", "robot", "collect")
ADOPTED: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("data/[!.]*.*", _START),
    ("bcq/*/checkpoint*.*", (*_START, "bcq")),
    ("bcq/*/*.*", (*_START, "bcq", "evaluate.num_candidates")),  # curves and diagnostics
    ("distill/*.*", (*_START, "bcq", "distill")),
    ("evaluation/*-expert.csv", (*_START, "evaluate")),
    ("evaluation/*-bcq.csv", (*_START, "bcq", "evaluate")),
)
"""Files that a run copies from its base, with the settings or sections that they depend on."""
AT_FIRST: Mapping[str, Any] = {"bcq.cosine": False, "distill.advantage_weight": 0.0}
"""What folders without a setting were made with, where this is not its default today."""
PACKAGES = ("torchrl", "tensordict", "robosuite", "mujoco", "gymnasium", "numpy", "h5py")


INPUTS = "inputs.json"
"""File with the digests of the files that a folder's settings name."""
Files = Mapping[str, Sequence[Path]]
"""Files that decide a run's results, by the setting that names them."""


def open_run(
    run_dir: Path,
    settings: Mapping[str, Any],
    defaults: Mapping[str, Any] | None = None,
    files: Files | None = None,
) -> None:
    """Creates a run folder, or checks that an existing one has the same settings.

    Writes ``config.yaml`` (all settings) and ``versions.json``. If the setting ``base`` names the
    folder of another run, a new run starts with those of its files that would come out the same
    (:data:`ADOPTED`). Several processes may call this at once for one folder.

    Args:
        run_dir: the folder.
        settings: the resolved configuration.
        defaults: defaults of the settings. A setting that an earlier version did not have counts
            as its default in that version's folders, or as in :data:`AT_FIRST`.
        files: files that decide the results. Their digests are stored in ``inputs.json``.

    Raises:
        ConfigError: naming the first setting that differs from the folder's run, or the first file
            whose content does.
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
    path, now = run_dir / "config.yaml", deciding(settings)
    if not path.exists():
        base = Path(settings["base"]) if settings.get("base") else None
        theirs = _settings_of(base, now, defaults) if base else {}
        # torch.__version__ contains the build (2.14.1+cu130); the package's metadata may not.
        versions = {"torch": str(torch.__version__)} | {name: _version(name) for name in PACKAGES}
        versions |= {"torchrl_bmrl": __version__, "python": platform.python_version()}
        if commit := _commit():
            versions["commit"] = commit
        write_atomic(run_dir / "versions.json", json.dumps(versions, indent=2) + "\n")
        write_atomic(path, yaml.safe_dump(dict(settings), sort_keys=False), replace=False)
        if base:  # if killed from here on, the run computes the missing files itself
            for pattern, keys in ADOPTED:
                if all(_section(theirs, key) == _section(now, key) for key in keys):
                    for source in base.glob(pattern):
                        target = run_dir / source.relative_to(base)
                        if not target.exists():  # another process may have made it
                            link_or_copy(source, target)
            if all(_section(theirs, key) == _section(now, key) for key in _START):
                # The demonstrations were imported from these.
                read = {key: x for key, x in _inputs(base).items() if key.startswith("tasks.")}
                _write_inputs(run_dir, read)
    before = _settings_of(run_dir, now, defaults)
    for key in sorted(before | now):
        if before.get(key) != now.get(key):
            raise other_setting(run_dir, key, now.get(key), before.get(key))
    _write_inputs(run_dir, check_files(run_dir, files or {}))


def check_files(run_dir: Path, files: Files) -> dict[str, str]:
    """Compares files with those that a folder's results were made from.

    Args:
        run_dir: the folder.
        files: the files by setting. A setting without files, since they are gone, is not compared.

    Returns:
        the digests of the files.

    Raises:
        ConfigError: naming the first setting whose files have another content.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> files = {"evaluate.policy": [folder / "policy"]}
        >>> write_atomic(folder / "policy", "first")
        >>> open_run(folder / "run", {"seed": 0}, files=files)
        >>> write_atomic(folder / "policy", "second")
        >>> check_files(folder / "run", files)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: ...: the content of evaluate.policy (.../policy) is ...
    """
    before = _inputs(run_dir)
    now = {key: digest_of(*paths) for key, paths in files.items() if paths}
    for key, digest in now.items():
        if before.get(key, digest) != digest:
            raise ConfigError(
                f"{run_dir}: the content of {key} ({files[key][0]}) is {digest[:12]} here and "
                f"{str(before[key])[:12]} in the folder's run (SHA-256); use the same content to "
                "continue, or another run_dir"
            )
    return now


def check_made_from(result: Path, files: Sequence[Path]) -> None:
    """Compares the files that a result is made from with those of its record, or writes the record.

    The record is ``<result>.sha256``. Files that are missing are not compared.

    Args:
        result: the file with the result, which may not exist yet.
        files: such as the checkpoint of the policy that is evaluated.

    Raises:
        ConfigError: if the result was made from other files.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> result, policy = folder / "lift-bcq.csv", folder / "policy"
        >>> write_atomic(policy, "first")
        >>> check_made_from(result, [policy])
        >>> write_atomic(result, "its episodes")
        >>> write_atomic(policy, "second")
        >>> check_made_from(result, [policy])
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: ...lift-bcq.csv: made from another .../policy; remove ...
    """
    record = result.with_name(f"{result.name}.sha256")
    if not files or not all(file.is_file() for file in files):
        return
    digest = digest_of(*files)
    if not result.exists() or not record.exists():
        write_atomic(record, digest + "\n")
    elif record.read_text(encoding="utf-8", errors="replace").strip() != digest:
        names = " or ".join(map(str, files))
        raise ConfigError(
            f"{result}: made from another {names}; remove this result to make it anew, or use "
            "another run_dir"
        )


def _inputs(run_dir: Path) -> dict[str, Any]:
    """Digests of a folder's files by setting; those of earlier versions have none."""
    path = run_dir / INPUTS
    found = read_json(path, "digests of files") if path.exists() else {}
    if not isinstance(found, dict):
        raise DataError(path, None, f"a {type(found).__name__}; valid: digests by setting")
    return found


def _write_inputs(run_dir: Path, digests: Mapping[str, str]) -> None:
    """Adds digests to those of a folder."""
    before = _inputs(run_dir)
    if digests.keys() - before.keys():
        write_atomic(run_dir / INPUTS, json.dumps(before | dict(digests), indent=2) + "\n")


def _settings_of(
    run_dir: Path, now: Mapping[str, Any], defaults: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Deciding settings of a folder's run; those that its version did not have are the defaults."""
    before, usual = deciding(read_settings(run_dir)), deciding(defaults or {})
    usual |= {key: AT_FIRST[key] for key in AT_FIRST if key in usual}
    return {key: usual[key] for key in now if key in usual and key not in before} | before


def _section(named: Mapping[str, Any], section: str) -> dict[str, Any]:
    """The settings of a section, or one setting, by dotted names."""
    return {key: x for key, x in named.items() if f"{key}.".startswith(f"{section}.")}


def other_setting(run_dir: Path, key: str, now: Any, before: Any) -> ConfigError:
    """Returns the error for a setting that differs from that of the folder's run.

    Example:
        >>> print(other_setting(Path("runs/mine"), "seed", 1, 0))
        runs/mine: seed is 1 here and 0 in the folder's run; use the same settings to continue, ...
    """
    return ConfigError(
        f"{run_dir}: {key} is {now} here and {before} in the folder's run; use the same settings "
        "to continue, or another run_dir"
    )


def deciding(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that a run's results depend on, by their dotted names.

    Example:
        >>> deciding({"seed": 0, "workers": 2, "bcq": {"lr": 0.001}})
        {'seed': 0, 'bcq.lr': 0.001}
    """
    named = flat({key: x for key, x in settings.items() if key not in FREE_TO_CHANGE})
    return {key: x for key, x in named if key not in FREE_TO_CHANGE}


def read_settings(run_dir: Path) -> dict[str, Any]:
    """Returns the settings of a run folder, nested as in ``config.yaml``.

    Args:
        run_dir: the run folder.

    Raises:
        DataError: if the file is missing or not YAML.

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
    """Reads a YAML file that contains a mapping.

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
    except (FileNotFoundError, IsADirectoryError) as error:
        raise DataError(path, None, "no such file") from error
    # PyYAML raises most of these for tags that do not fit their values.
    except (
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
        yaml.YAMLError,
    ) as error:
        raise DataError(path, None, f"not YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        found = "is empty" if content is None else f"contains a {type(content).__name__}"
        raise DataError(path, None, f"{found}; valid: a mapping")
    return content


class _Loader(yaml.SafeLoader):
    """Refuses repeated keys, and references: a few of these can expand to more than any memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("contains a reference; valid: values written out")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.YAMLError(f"contains the key {key.value} twice; valid: each key once")
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        return super().construct_mapping(node, deep)


def read_versions(run_dir: Path) -> dict[str, str]:
    """Returns the versions that a run uses, by package and for ``python``; some may be ``"None"``.

    Args:
        run_dir: the run folder.

    Raises:
        DataError: if ``versions.json`` is missing or damaged.

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
    """Commit of the sources, with ``+`` if they were changed since; ``None`` outside git."""
    source = Path(__file__)
    git = ["git", "-C", str(source.parent)]
    try:
        # An installed copy may lie in another project's repository, which does not track it.
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
