"""Locks on run folders: one process at a time, and no folder left by a run that never started."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import DataError, FolderInUseError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import parse_json, write_atomic
from torchrl_bmrl.run.folder import INPUTS, Files, open_run

with needs("recipes"):
    from filelock import FileLock, Timeout


WHOLE_RUN = "_run"
"""The part that a run of all tasks locks beside them; no task can have this name."""


@contextlib.contextmanager
def lock(folder: Path, names: Sequence[str] = (WHOLE_RUN,)) -> Iterator[None]:
    """Locks a folder, or named parts of it, for this process.

    The operating system releases the locks of a process when it ends, also when it is killed. The
    subfolder ``.locks`` stays.

    Args:
        folder: created if missing.
        names: names of the parts, in any order.

    Raises:
        FolderInUseError: naming the process and the host that have the lock; no part is locked
            then.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with lock(folder, ["reach"]), lock(folder, ["lift"]):
        ...     pass
        >>> with lock(folder), lock(folder):
        ...     pass
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.FolderInUseError: ...: in use by process ... on ...
    """
    locks = folder / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    owner = {"process": os.getpid(), "host": socket.gethostname()}
    with contextlib.ExitStack() as stack:
        for name in sorted(names):
            # Not in the lock file: writing it would replace the file that is locked.
            owner_file = locks / f"{name}.json"
            try:
                stack.enter_context(FileLock(locks / f"{name}.lock", timeout=0))
            except Timeout:
                raise FolderInUseError(folder, *_owner(owner_file)) from None
            write_atomic(owner_file, json.dumps(owner) + "\n")
        yield


def check_no_linked_folders(folder: str | os.PathLike[str]) -> None:
    """Checks that no folder inside of a folder is a link: files elsewhere would change through it.

    Files may be links, because they are replaced and never modified. The folders ``wandb`` are left
    out: Weights & Biases links its newest run.

    Args:
        folder: The folder, which may be a link itself, or missing.

    Raises:
        DataError: naming the first link.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> (folder / "bcq").symlink_to(tempfile.mkdtemp())
        >>> check_no_linked_folders(folder)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: .../bcq: is a link to /...; valid: a folder, ...
    """
    for path in sorted(Path(folder).rglob("*")):
        inside = path.relative_to(folder).parts[:-1]
        if path.is_symlink() and path.is_dir() and "wandb" not in inside:
            message = f"is a link to {path.resolve()}; valid: a folder, as files would change there"
            raise DataError(path, None, message)


@contextlib.contextmanager
def lock_run(
    run_dir: Path,
    settings: Mapping[str, Any],
    names: Sequence[str] = (WHOLE_RUN,),
    defaults: Mapping[str, Any] | None = None,
    files: Files | None = None,
) -> Iterator[None]:
    """Locks a run folder (:func:`lock`) and opens it (:func:`~torchrl_bmrl.run.folder.open_run`).

    If the block raises before it wrote any file, the files and folders that this function created
    are removed.

    Args:
        run_dir: the folder, created if missing.
        settings: the resolved configuration.
        names: names of the parts to lock.
        defaults: of the settings, see :func:`~torchrl_bmrl.run.folder.open_run`.
        files: that decide the results, see there.

    Raises:
        DataError: if a folder in the run folder is a link.
        BMRLError: the errors of ``lock`` and ``open_run``.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "runs" / "mine"
        >>> try:
        ...     with lock_run(folder, {"seed": 0}):
        ...         raise FileNotFoundError("demonstrations")
        ... except FileNotFoundError:
        ...     folder.parent.exists()
        False
    """
    check_no_linked_folders(run_dir)
    before = set(run_dir.rglob("*"))
    missing = [folder for folder in (run_dir, *run_dir.parents) if not folder.exists()]
    with lock(run_dir, names):
        try:
            open_run(run_dir, settings, defaults, files)
            yield
        except Exception:
            ours = {run_dir / name for name in ("config.yaml", "versions.json", INPUTS)}
            ours |= {run_dir / ".locks" / f"{name}.{end}" for name in names for end in ENDS}
            new = set(run_dir.rglob("*")) - before
            ours |= set(run_dir.glob("*/**/.locks/*"))
            # Any other file is a result, or another process wrote it.
            if {path for path in new if not path.is_dir()} <= ours:
                _remove(new, missing)
            raise


ENDS = ("lock", "json")


def _remove(paths: set[Path], folders: Sequence[Path]) -> None:
    """Removes files, then empty folders from the innermost outwards."""
    with contextlib.suppress(OSError):
        for path in sorted(paths, key=lambda path: len(path.parts), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        for folder in folders:
            folder.rmdir()


def _owner(path: Path) -> tuple[str, str]:
    try:
        owner = parse_json(path.read_text(encoding="utf-8"))
        return str(owner["process"]), str(owner["host"])
    except (OSError, ValueError, KeyError, TypeError):  # locked, and the file not yet written
        return "unknown", "an unknown host"
