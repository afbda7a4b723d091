"""Workers that start at once and share the memory of what they import.

A new Python process needs seconds to import torch, TorchRL and a simulator, and its own memory for
them. On Linux a server process therefore imports them once, and every worker is a copy of it. The
server is Python's own (``multiprocessing``'s start method ``"forkserver"``); it has no threads and
has used no device, so copying it is safe. Elsewhere every worker imports for itself (``"spawn"``).
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import resource_tracker

METHOD = "forkserver" if sys.platform == "linux" else "spawn"
"""How worker processes are started."""
FOR_THE_RUN = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that a terminal or a cluster sends to all processes of a run."""
IMPORTS = "TORCHRL_BMRL_SERVER_IMPORTS"
"""Environment variable with the modules that the server imports."""
PACKAGES = ("torchrl_bmrl", "hydra", "omegaconf", "tqdm")
"""Packages whose modules workers need as much as this process does."""


def start_server(*modules: str) -> None:
    """Starts the server that workers are copies of, unless it runs already.

    In the background it imports what this process has imported of :data:`PACKAGES`, and further
    modules. Each worker imports for itself what the server cannot. Does nothing except on Linux.

    Args:
        *modules: names of further modules.

    Example:
        >>> start_server("torchrl_bmrl.functional")
    """
    if METHOD != "forkserver":
        return
    from multiprocessing import forkserver  # which some systems do not have

    own = [name for name in sys.modules if name.partition(".")[0] in PACKAGES]
    forkserver.set_forkserver_preload(["torchrl_bmrl.run.forked_server"])
    imports = " ".join(dict.fromkeys([*own, *modules]))
    with _inherited(IMPORTS, imports), one_thread(), held_signals():
        forkserver.ensure_running()


@contextmanager
def held_signals() -> Iterator[None]:
    """Holds signals back from the processes that start inside, until these have their handlers.

    Until then Python would end a process with a traceback.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, FOR_THE_RUN)
    try:
        resource_tracker.ensure_running()  # with the first process; it unblocks signals here
        signal.pthread_sigmask(signal.SIG_BLOCK, FOR_THE_RUN)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def one_thread() -> AbstractContextManager[None]:
    """Context in which new processes use one thread: numpy reads this at its import."""
    return _inherited("OMP_NUM_THREADS", "1")


@contextmanager
def _inherited(name: str, value: str) -> Iterator[None]:
    """Sets an environment variable for the processes that start inside."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
