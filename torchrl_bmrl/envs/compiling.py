"""Compiles scenes that came with data: in a process of limited memory and time, of known files.

A few lines of MJCF can ask for years of computing, or for all memory. The process ends when it
reaches a limit, and with the process that started it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

from torchrl_bmrl.extras import needs

if sys.platform != "win32":
    import resource

_WAIT = 60
"""Longest wait for a second of a compilation [s], on a machine that has much else to do."""


def compile_scene(text: str, *, seconds: int = 7, memory: int = 2**31) -> Any:
    """Compiles MJCF in a process of its own, and returns the ``mujoco.MjModel``.

    MuJoCo would also keep four times the model's memory.

    Args:
        text: the MJCF.
        seconds: largest processor time; a whole scene of robosuite takes less than 2 s.
        memory: largest memory beside this process's, and of the model [bytes]; such a scene takes
            0.7 GB, and asks for more than 1 GB.

    Raises:
        ValueError: if it does not compile, or takes more.
    """
    with needs("robosuite"):
        import mujoco
    if not hasattr(os, "fork"):
        return mujoco.MjModel.from_xml_string(text)
    with tempfile.TemporaryDirectory() as folder:
        model, message = Path(folder, "model.mjb"), Path(folder, "message")
        # Found before the fork: afterwards another thread's lock might be held for ever.
        end_with = _end_with_parent()
        parent = os.getpid()
        with warnings.catch_warnings():
            # The child neither starts threads nor needs those of this process.
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            try:
                end_with(parent)
                _limit(seconds, memory)
                mujoco.mj_saveModel(mujoco.MjModel.from_xml_string(text), str(model))
                os._exit(0)
            except BaseException as error:
                message.write_text(f"{error or type(error).__name__}", encoding="utf-8")
            finally:
                os._exit(1)
        if _wait(child, seconds * _WAIT) == 0:
            return mujoco.MjModel.from_binary_path(str(model))
        if message.exists() and (reason := message.read_text(encoding="utf-8")):
            raise ValueError(reason)
    raise ValueError(f"it takes more than {seconds} s or {memory >> 20} MB, or ends its process")


def end_with_parent(parent: int) -> None:
    """Lets the kernel end this process with its parent, where it can (Linux).

    Args:
        parent: id of the parent, which may have ended already.
    """
    _end_with_parent()(parent)


def _end_with_parent() -> Any:
    try:
        control = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
    except (AttributeError, OSError):
        control = None

    def end_with(parent: int) -> None:
        if control is not None:
            control(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
            if os.getppid() != parent:
                os._exit(1)

    return end_with


def _limit(seconds: int, memory: int) -> None:
    """Limits this process: the time and memory that it takes from now on, and its files."""
    limits = {
        resource.RLIMIT_CPU: seconds,
        resource.RLIMIT_FSIZE: memory,
        resource.RLIMIT_CORE: 0,
    }
    if sys.platform == "linux":  # elsewhere it is unknown what this process has already
        pages = Path("/proc/self/statm").read_text().split()
        space, data = (int(pages[i]) * resource.getpagesize() for i in (0, 5))
        limits[resource.RLIMIT_DATA] = data + memory
        limits[resource.RLIMIT_AS] = space + 4 * memory  # threads reserve more than they use
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def _wait(child: int, most: float) -> int:
    """Waits for a process; one that takes too long, or that nobody waits for any more, is ended."""
    end, pause = time.monotonic() + most, 0.001
    try:
        while True:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return status
            if time.monotonic() > end:
                break
            time.sleep(pause)
            pause = min(2 * pause, 0.05)
    except BaseException:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]
