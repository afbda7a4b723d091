"""Cache of compiled code: its directory, and when it is invalid."""

from __future__ import annotations

import atexit
import hashlib
import io
import logging
import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from numbers import Number
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import write_atomic

with needs("robosuite"):
    import numba
    import numpy as np
    from numba.core import config, dispatcher
    from numba.core.caching import FunctionCache, IndexDataCacheFile

log = logging.getLogger(__name__)

PACKAGES = ("robosuite", "mujoco", "numba", "llvmlite", "numpy", "scipy")
"""Another version or another place of one of these packages is another cache."""
_CHECKSUM = hashlib.sha256().digest_size


def numba_cache_dir() -> Path:
    """The user's directory of compiled code: ``$XDG_CACHE_HOME/torchrl_bmrl/numba``.

    numba's own setting ``NUMBA_CACHE_DIR`` takes precedence. Without a directory that can be
    written, such as for a user without a home, it is a temporary one of this process.
    """
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(config.CACHE_DIR or Path(home) / "torchrl_bmrl" / "numba")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        return folder
    except (OSError, RuntimeError) as error:
        return _temporary_dir(str(error))


@cache
def _temporary_dir(reason: str) -> Path:
    folder = tempfile.mkdtemp(prefix="torchrl_bmrl-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    log.debug("compiled code is kept for this process only (%s)", reason)
    return Path(folder)


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
    dispatcher.FunctionCache = _CheckedCache  # type: ignore[attr-defined]
    try:
        yield
    finally:
        config.CACHE_DIR = before
        dispatcher.FunctionCache = FunctionCache  # type: ignore[attr-defined]


class _CheckedCache(FunctionCache):
    """numba's cache of one function; code that is damaged or cannot be written is no error."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        kept: Any = self._cache_file  # type: ignore[has-type]
        self._cache_file = _CheckedFile(
            kept._cache_path, self._impl.filename_base, kept._source_stamp
        )

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            log.warning("compiled code cannot be kept in %s (%s)", self.cache_path, error)


class _CheckedFile(IndexDataCacheFile):
    """numba's files of one function, with checksums: a damaged file counts as missing.

    numba reads them as pickles, and runs the code in them.
    """

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        # numba ignores what comes after its own content.
        write_atomic(filepath, content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if _is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        return super()._load_data(name) if _is_whole(self._data_path(name)) else None

    def _data_name(self, number: int) -> str:
        # numba counts. Of two processes that begin at once, one would take the other's code.
        return super()._data_name(uuid.uuid4().int)


def _is_whole(path: str) -> bool:
    try:
        content = Path(path).read_bytes()
    except OSError:
        return False
    text, checksum = content[:-_CHECKSUM], content[-_CHECKSUM:]
    return bool(text) and hashlib.sha256(text).digest() == checksum


def cached_njit(function: Callable[..., Any]) -> Any:
    """``numba.njit`` with a cache that is valid until something that it compiles changes."""
    with user_numba_cache(function):
        return numba.njit(cache=True)(function)


def fingerprint(*functions: Any) -> str:
    """Hash of everything that numba compiles for some functions, as 16 hexadecimal digits.

    It covers Python; the versions and places of :data:`PACKAGES`; each function's code, file,
    defaults and closure; the functions that they call, recursively; and global constants, which
    numba compiles in.
    """
    digest = hashlib.sha256(_environment().encode())
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
            digest.update(_source(value.__code__.co_filename))
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
def _source(path: str) -> bytes:
    """Hash of a file, which also defines the named tuples whose places numba compiles in."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).digest()
    except OSError:  # typed in, or in an archive
        return b""


@cache
def _environment() -> str:
    found: dict[str, Any] = {"python": (sys.version, sys.prefix)}
    for package in PACKAGES:
        spec = find_spec(package)
        try:
            found[package] = version(package), spec and spec.origin
        except PackageNotFoundError:  # a copy on the path
            found[package] = "unknown", spec and spec.origin
    return repr(found)


def _codes(code: CodeType) -> list[CodeType]:
    """Code objects of a function and of the comprehensions and functions inside it."""
    inner = [each for each in code.co_consts if isinstance(each, CodeType)]
    return [code, *(nested for each in inner for nested in _codes(each))]
