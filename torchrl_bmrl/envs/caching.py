"""Cache of compiled code: its directory, and when it is invalid."""

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
"""A new version of one of these packages invalidates the cache."""


def numba_cache_dir() -> Path:
    """The user's directory of compiled code: ``$XDG_CACHE_HOME/torchrl_bmrl/numba``.

    numba's own setting ``NUMBA_CACHE_DIR`` takes precedence.
    """
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(config.CACHE_DIR or Path(home) / "torchrl_bmrl" / "numba")


@contextmanager
def user_numba_cache(*functions: Any) -> Iterator[None]:
    """Caches functions decorated inside once per user, wherever their package is installed.

    By default numba writes its cache beside the source. That fails in a read-only installation, and
    the cache is lost with a container. The caches of other packages are not moved.

    Args:
        *functions: compiled functions; their :func:`fingerprint` names the subdirectory. numba
            alone notices a change of a function's file, but not of the functions that it calls.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = str(numba_cache_dir() / fingerprint(*functions))
    try:
        yield
    finally:
        config.CACHE_DIR = before


def cached_njit(function: Callable[..., Any]) -> Any:
    """``numba.njit`` with a cache that is valid until something that it compiles changes."""
    with user_numba_cache(function):
        return numba.njit(cache=True)(function)


def fingerprint(*functions: Any) -> str:
    """Hash of everything that numba compiles for some functions, as 16 hexadecimal digits.

    It covers the versions of :data:`PACKAGES`; each function's code, defaults and closure; the
    functions that they call, recursively; and global constants, which numba compiles in.
    """
    digest = hashlib.sha256(_versions().encode())
    todo, seen = list(functions), set()
    while todo:
        value = todo.pop()
        value = getattr(value, "py_func", value)  # the function that numba decorated
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
                if isinstance(named, ModuleType):  # its version covers its own functions
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
    """Code objects of a function and of the comprehensions and functions inside it."""
    inner = [each for each in code.co_consts if isinstance(each, CodeType)]
    return [code, *(nested for each in inner for nested in _codes(each))]
