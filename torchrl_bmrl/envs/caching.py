"""Where compiled code is kept."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba.core import config


def numba_cache_dir() -> Path:
    """The user's directory of compiled code: ``$XDG_CACHE_HOME/torchrl_bmrl/numba``.

    ``NUMBA_CACHE_DIR``, numba's own setting, has precedence.
    """
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(config.CACHE_DIR or Path(home) / "torchrl_bmrl" / "numba")


@contextmanager
def user_numba_cache() -> Iterator[None]:
    """Functions decorated inside are compiled once per user, wherever their package is installed.

    By default numba writes beside the source, which fails in a read-only installation and is lost
    with a container's. Other packages' functions are left where they are.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = str(numba_cache_dir())
    try:
        yield
    finally:
        config.CACHE_DIR = before
