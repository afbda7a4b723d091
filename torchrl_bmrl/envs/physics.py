"""Which MuJoCo robosuite works with, and where its shared library is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrl_bmrl.errors import MissingExtraError

BELOW = (3, 10)
"""robosuite 1.5 fails with this and later versions of MuJoCo."""


def check_mujoco(version: str | None) -> None:
    """Refuses a version of MuJoCo with which robosuite fails or silently misbehaves.

    Args:
        version: ``mujoco.__version__``, or ``None`` if it is missing. It is missing after pip has
            uninstalled one of two distributions that share files.

    Raises:
        MissingExtraError: with the reason and what to install.

    Example:
        >>> check_mujoco("3.9.0")
        >>> try:
        ...     check_mujoco("4.0.0")
        ... except MissingExtraError as error:
        ...     print(error.reason)
        4.0.0 is installed; robosuite works below 3.10
    """
    if version is None:
        reason = "files are missing; pip install --force-reinstall 'mujoco<3.10' restores them"
    elif tuple(map(int, version.split(".")[:2])) >= BELOW:
        reason = f"{version} is installed; robosuite works below {'.'.join(map(str, BELOW))}"
    else:
        return
    raise MissingExtraError("mujoco", "robosuite", reason)


@contextmanager
def kept_environment(variable: str) -> Iterator[None]:
    """Restores an environment variable on exit.

    Importing robosuite sets ``MUJOCO_GL`` to EGL, whatever the user chose.

    Example:
        >>> with kept_environment("NO_SUCH_VARIABLE"):
        ...     os.environ["NO_SUCH_VARIABLE"] = "egl"
        >>> "NO_SUCH_VARIABLE" in os.environ
        False
    """
    before = os.environ.get(variable)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(variable, None)
        else:
            os.environ[variable] = before


def mujoco_library(folder: Path, version: str, platform: str) -> Path | str:
    """Path of the shared library of a MuJoCo version, or the reason why there is none.

    The folder may contain libraries of other versions: pip leaves those of mujoco 4 behind. Loading
    a second version crashes the process.

    Args:
        folder: directory of the Python package ``mujoco``.
        version: such as ``"3.8.1"``.
        platform: value of ``sys.platform``.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> (folder / "libmujoco.so.4.0.0").touch()
        >>> mujoco_library(folder, "3.8.1", "linux").replace(str(folder), "folder")
        'no libmujoco.so.3.8.1 in folder (there: libmujoco.so.4.0.0)'
    """
    name = {"darwin": f"libmujoco.{version}.dylib", "win32": "mujoco.dll"}.get(
        platform, f"libmujoco.so.{version}"
    )
    if (folder / name).is_file():
        return folder / name
    patterns = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco*.dll")
    found = sorted(path.name for pattern in patterns for path in folder.glob(pattern))
    return f"no {name} in {folder} (there: {', '.join(found) or 'none'})"
