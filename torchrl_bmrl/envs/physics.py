"""The MuJoCo that robosuite works with, and its library."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrl_bmrl.errors import MissingExtraError

BELOW = (3, 10)
"""robosuite 1.5 fails from this version of MuJoCo on."""


def check_mujoco(version: str | None) -> None:
    """Refuses a MuJoCo that robosuite fails with, in a call or in silence.

    Args:
        version: ``mujoco.__version__``; ``None`` where it has none, which is what pip leaves of it
            when one of two distributions that share files is uninstalled.

    Raises:
        MissingExtraError: saying why, and what to install.

    Example:
        >>> check_mujoco("3.9.0")
        >>> try:
        ...     check_mujoco("4.0.0")
        ... except MissingExtraError as error:
        ...     print(error.reason)
        4.0.0 is installed; robosuite works below 3.10
    """
    if version is None:
        reason = "files of it are gone; pip install --force-reinstall 'mujoco<3.10' brings them"
    elif tuple(map(int, version.split(".")[:2])) >= BELOW:
        reason = f"{version} is installed; robosuite works below {'.'.join(map(str, BELOW))}"
    else:
        return
    raise MissingExtraError("mujoco", "robosuite", reason)


@contextmanager
def kept_environment(variable: str) -> Iterator[None]:
    """Leaves a variable of the environment as it was.

    robosuite's import sets ``MUJOCO_GL`` to EGL, whatever the machine has and the user chose.

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
    """The library that mujoco's bindings of a version have loaded, or why there is none.

    Libraries of other versions may lie beside it: mujoco 4's belong to distributions that pip
    leaves behind. Loading a second one ends the process.

    Args:
        folder: of mujoco's Python package.
        version: of mujoco, such as ``"3.8.1"``.
        platform: as ``sys.platform`` has it.

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
