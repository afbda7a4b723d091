"""One run at a time in a folder."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

from torchrl_bmrl.errors import FolderInUseError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import write_atomic

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


def _owner(path: Path) -> tuple[str, str]:
    try:
        owner = json.loads(path.read_text(encoding="utf-8"))
        return str(owner["process"]), str(owner["host"])
    except (OSError, ValueError, KeyError, TypeError):  # it has only just taken the lock
        return "unknown", "an unknown host"
