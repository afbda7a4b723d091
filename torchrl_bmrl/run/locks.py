"""One run at a time in a folder, and none where nothing came of it."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import FolderInUseError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.run.folder import open_run

with needs("recipes"):
    from filelock import FileLock, Timeout


@contextlib.contextmanager
def hold(folder: Path, names: Sequence[str] = ("run",)) -> Iterator[None]:
    """Holds a folder, or named parts of it, for this process.

    The operating system gives up a process's locks when it ends, however it ends: what a dead
    process held is simply taken. ``.locks`` in the folder stays.

    Args:
        folder: created if missing.
        names: of the parts, in any order.

    Raises:
        FolderInUseError: naming the process and the host that hold it; nothing is held then.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with hold(folder, ["reach"]), hold(folder, ["lift"]):
        ...     pass
        >>> with hold(folder), hold(folder):
        ...     pass
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.FolderInUseError: ...: in use by process ... on ...
    """
    locks = folder / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    owner = {"process": os.getpid(), "host": socket.gethostname()}
    with contextlib.ExitStack() as held:
        for name in sorted(names):
            # Not the lock's own file, which must stay the same one.
            said = locks / f"{name}.json"
            lock = FileLock(locks / f"{name}.lock", timeout=0)
            try:
                held.enter_context(lock)
            except Timeout:
                raise FolderInUseError(folder, *_owner(said)) from None
            write_atomic(said, json.dumps(owner) + "\n")
        yield


@contextlib.contextmanager
def hold_run(
    run_dir: Path, settings: Mapping[str, Any], names: Sequence[str] = ("run",)
) -> Iterator[None]:
    """Holds a run's folder (:func:`hold`) and opens it (:func:`~torchrl_bmrl.run.folder.open_run`).

    Where an error comes before anything was done, what this has written is gone again: the folder
    of a run that could not start, the locks in another run's.

    Args:
        run_dir: the folder, created if missing.
        settings: the resolved configuration.
        names: of the parts to hold.

    Raises:
        BMRLError: of ``hold`` and ``open_run``.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "runs" / "mine"
        >>> try:
        ...     with hold_run(folder, {"seed": 0}):
        ...         raise FileNotFoundError("demonstrations")
        ... except FileNotFoundError:
        ...     folder.parent.exists()
        False
    """
    before = set(_below(run_dir))
    missing = [folder for folder in (run_dir, *run_dir.parents) if not folder.exists()]
    with hold(run_dir, names):
        try:
            open_run(run_dir, settings)
            yield
        except Exception:
            ours = {run_dir / name for name in ("config.yaml", "versions.json")}
            ours |= {run_dir / ".locks" / f"{name}.{end}" for name in names for end in ENDS}
            new = set(_below(run_dir)) - before
            # Anything else was done here, or is another process's.
            if {path for path in new if not path.is_dir()} <= ours:
                _remove(new, missing)
            raise


ENDS = ("lock", "json")


def _below(folder: Path) -> Iterator[Path]:
    return folder.rglob("*")


def _remove(paths: set[Path], folders: Sequence[Path]) -> None:
    """Removes files, then folders from the innermost on as far as they are empty."""
    with contextlib.suppress(OSError):
        for path in sorted(paths, key=lambda path: len(path.parts), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        for folder in folders:
            folder.rmdir()


def _owner(path: Path) -> tuple[str, str]:
    try:
        owner = json.loads(path.read_text(encoding="utf-8"))
        return str(owner["process"]), str(owner["host"])
    except (OSError, ValueError, KeyError, TypeError):  # it has only just taken the lock
        return "unknown", "an unknown host"
