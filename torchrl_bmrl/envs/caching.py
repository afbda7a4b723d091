"""Where compiled code is kept, and for what it stands."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from numbers import Number
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import numba
    import numpy as np
    from numba.core import config

PACKAGES = ("robosuite", "mujoco", "numba", "numpy")
"""Another version of one of them compiles anew."""


def numba_cache_dir() -> Path:
    """The user's directory of compiled code: ``$XDG_CACHE_HOME/torchrl_bmrl/numba``.

    ``NUMBA_CACHE_DIR``, numba's own setting, has precedence.
    """
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(config.CACHE_DIR or Path(home) / "torchrl_bmrl" / "numba")


@contextmanager
def user_numba_cache(*functions: Any) -> Iterator[None]:
    """Functions decorated inside are compiled once per user, wherever their package is installed.

    By default numba writes beside the source, which fails in a read-only installation and is lost
    with a container's. Other packages' functions are left where they are.

    Args:
        *functions: that are compiled in: another :func:`fingerprint` is another directory. numba
            itself compares the file of a function with what was compiled, not what it calls.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = str(numba_cache_dir() / fingerprint(*functions))
    try:
        yield
    finally:
        config.CACHE_DIR = before


def cached_njit(function: Callable[..., Any]) -> Any:
    """``numba.njit`` whose result is kept for as long as all that it compiles is the same."""
    with user_numba_cache(function):
        return numba.njit(cache=True)(function)


def fingerprint(*functions: Any) -> str:
    """What numba compiles of functions, as 16 hexadecimal digits.

    It depends on the versions of :data:`PACKAGES`, on each function's code, defaults and closure,
    and on everything that these name outside of themselves: other functions, as deep as they call
    each other, and constants, which numba compiles in.
    """
    digest = hashlib.sha256(_versions().encode())
    todo, seen = list(functions), set()
    while todo:
        value = todo.pop()
        value = getattr(value, "py_func", value)  # of what numba has decorated
        if isinstance(value, FunctionType):
            if value in seen:
                continue
            seen.add(value)
            codes = _codes(value.__code__)
            names = sorted({name for code in codes for name in code.co_names})
            for code in codes:
                digest.update(code.co_code)
            todo += [x for code in codes for x in code.co_consts if not isinstance(x, CodeType)]
            todo += [value.__defaults__, value.__kwdefaults__]
            todo += [cell.cell_contents for cell in value.__closure__ or ()]
            for name in names:
                digest.update(name.encode())
                named = value.__globals__.get(name)
                todo.append(named)
                if isinstance(named, ModuleType):  # its own functions are known by its version
                    parts = [getattr(named, part, None) for part in names]
                    todo += [x for x in parts if _is_compiled_in(x)]
        elif isinstance(value, np.ndarray):
            digest.update(repr((value.dtype.str, value.shape)).encode() + value.tobytes())
        elif isinstance(value, tuple | list | dict):
            todo += value.items() if isinstance(value, dict) else value
        elif not isinstance(value, ModuleType):
            digest.update(repr(value).encode())
    return digest.hexdigest()[:16]


def _is_compiled_in(value: Any) -> bool:
    return hasattr(value, "py_func") or isinstance(value, Number | np.ndarray)


@cache
def _versions() -> str:
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:  # a copy on the path
            versions[package] = "unknown"
    return repr(versions)


def _codes(code: CodeType) -> list[CodeType]:
    """A function's code and that of the comprehensions and functions inside."""
    inner = [each for each in code.co_consts if isinstance(each, CodeType)]
    return [code, *(nested for each in inner for nested in _codes(each))]
