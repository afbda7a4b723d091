"""Imports of packages that belong to an extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torchrl_bmrl.errors import MissingExtraError


@contextmanager
def needs(extra: str) -> Iterator[None]:
    """Context for imports of an extra's packages: a failing import names the extra.

    Args:
        extra: of this library, such as ``"data"``.

    Raises:
        MissingExtraError: naming the package and the extra, and the reason if the package is
            installed but fails.

    Example:
        >>> with needs("data"):
        ...     import no_such_package
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.MissingExtraError: no no_such_package; valid: pip install \
"torchrl_bmrl[data]"
    """
    try:
        yield
    except MissingExtraError:
        raise  # from a module of this library, which has named its own extra
    except ImportError as error:
        name = (error.name or "").partition(".")[0]
        if name == "torchrl_bmrl":
            raise
        gone = isinstance(error, ModuleNotFoundError) and name
        reason = None if gone else str(error).strip().partition("\n")[0]
        raise MissingExtraError(name or f"package of [{extra}]", extra, reason) from error
