"""Errors of this library; all derive from :class:`BMRLError`."""

from __future__ import annotations

import signal
from collections.abc import Iterable
from pathlib import Path


class BMRLError(ValueError):
    """Base of the library's errors: catch it to catch them all.

    Example:
        >>> try:
        ...     raise ConfigError("batch_size must be positive, got 0")
        ... except BMRLError as error:
        ...     print(error)
        batch_size must be positive, got 0
    """


class ConfigError(BMRLError):
    """Options that are invalid, alone or together.

    Example:
        >>> raise ConfigError("pass either action_spec or bounds, not both")
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: pass either action_spec or bounds, not both
    """


class UnknownNameError(BMRLError):
    """A name that is not one of the valid choices.

    Args:
        kind: what is named, such as ``"task"``.
        value: the given name.
        valid: the valid names.

    Example:
        >>> print(UnknownNameError("task", "lft", ["reach", "lift"]))
        unknown task 'lft'; valid tasks: reach, lift
    """

    def __init__(self, kind: str, value: object, valid: Iterable[object]) -> None:
        self.kind = kind
        self.value = value
        self.valid = tuple(valid)
        super().__init__(kind, value, self.valid)

    def __str__(self) -> str:
        choices = ", ".join(map(str, self.valid)) or "none"
        return f"unknown {self.kind} {self.value!r}; valid {_plural(self.kind)}: {choices}"


class MissingExtraError(BMRLError, ImportError):
    """A package of one of this library's extras that is not installed, or not usable.

    Args:
        package: the package.
        extra: the extra that installs it.
        reason: why it is not usable; ``None`` if it is not installed.

    Example:
        >>> print(MissingExtraError("h5py", "data"))
        no h5py; valid: pip install "torchrl_bmrl[data]"
        >>> print(MissingExtraError("matplotlib", "reports", "libpng.so: no such file"))
        no usable matplotlib (libpng.so: no such file); valid: pip install "torchrl_bmrl[reports]"
    """

    def __init__(self, package: str, extra: str, reason: str | None = None) -> None:
        self.package = package
        self.extra = extra
        self.reason = reason
        super().__init__(package, extra, reason)
        self.name = package  # ImportError's own

    def __str__(self) -> str:
        what = f"usable {self.package} ({self.reason})" if self.reason else self.package
        return f'no {what}; valid: pip install "torchrl_bmrl[{self.extra}]"'


class DataError(BMRLError):
    """A dataset file that is missing, damaged or not in the expected layout.

    Args:
        path: the file.
        key: the group, dataset or attribute that is wrong; ``None`` for the file as a whole.
        message: what is wrong.

    Example:
        >>> print(DataError("lift.hdf5", "data/demo_0/rewards", "not a number in row 3"))
        lift.hdf5: data/demo_0/rewards: not a number in row 3
    """

    def __init__(self, path: str | Path, key: str | None, message: str) -> None:
        self.path = Path(path)
        self.key = key
        self.message = message
        super().__init__(path, key, message)

    def __str__(self) -> str:
        where = [str(self.path)] if self.key is None else [str(self.path), self.key]
        return ": ".join([*where, self.message])


class CheckpointError(BMRLError):
    """A checkpoint that cannot be read, or does not fit the networks.

    Args:
        path: the checkpoint.
        message: what is wrong.

    Example:
        >>> print(CheckpointError("runs/lift.safetensors", "no such file"))
        runs/lift.safetensors: no such file
    """

    def __init__(self, path: str | Path, message: str) -> None:
        self.path = Path(path)
        self.message = message
        super().__init__(path, message)

    def __str__(self) -> str:
        return f"{self.path}: {self.message}"


class RenderError(BMRLError):
    """Pictures that cannot be rendered because no graphics library works.

    Args:
        problems: the error of each library that was tried.

    Example:
        >>> print(RenderError(["egl: no such library"]))
        no pictures can be rendered here (egl: no such library)
    """

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        super().__init__(self.problems)

    def __str__(self) -> str:
        return f"no pictures can be rendered here ({'; '.join(self.problems)})"


class FolderInUseError(BMRLError):
    """A run folder that another process uses.

    Args:
        folder: the folder.
        process: number of that process.
        host: the machine of that process.

    Example:
        >>> print(FolderInUseError("runs/a", 4711, "node3"))
        runs/a: in use by process 4711 on node3; wait for it, or give another run_dir
    """

    def __init__(self, folder: str | Path, process: int | str, host: str) -> None:
        self.folder = Path(folder)
        self.process = process
        self.host = host
        super().__init__(folder, process, host)

    def __str__(self) -> str:
        return (
            f"{self.folder}: in use by process {self.process} on {self.host}; wait for it, or give "
            "another run_dir"
        )


class StoppedError(BMRLError):
    """A run that was stopped by a signal.

    Args:
        signal: the signal.

    Example:
        >>> print(StoppedError(signal.SIGTERM))
        stopped by SIGTERM; finished work is saved, the same command continues it
    """

    def __init__(self, signal: signal.Signals) -> None:
        self.signal = signal
        super().__init__(signal)

    def __str__(self) -> str:
        return (
            f"stopped by {self.signal.name}; finished work is saved, the same command continues it"
        )


def _plural(noun: str) -> str:
    """Regular English plural of a noun.

    Example:
        >>> [_plural(noun) for noun in ("task", "policy", "loss", "key")]
        ['tasks', 'policies', 'losses', 'keys']
        >>> _plural("option of task lift")
        'options of task lift'
    """
    noun, of, whole = noun.partition(" of ")
    if noun.endswith("y") and noun[-2:-1] not in set("aeiou"):
        return f"{noun[:-1]}ies{of}{whole}"
    ending = "es" if noun.endswith(("s", "x", "ch", "sh")) else "s"
    return f"{noun}{ending}{of}{whole}"
