"""Writes files and folders atomically, and reads JSON with typed errors."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import DataError


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, replace: bool = True) -> Iterator[Path]:
    """Yields a temporary path that becomes ``path`` when the block succeeds.

    The temporary file lies in the same folder (created if missing), so that the final rename is
    atomic. Its name starts with a dot and ends in ``.tmp``, so that patterns for finished files
    (``*.hdf5``) do not match what a killed process may leave. If the block raises, the temporary
    file is removed and an existing ``path`` stays.

    Args:
        path: The file to write or replace.
        replace: ``False`` to keep a file that another process has written meanwhile.

    Yields:
        Path to write to; the block must create the file and close it.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with atomic_path(folder / "numbers.txt") as temporary:
        ...     _ = temporary.write_text("1 2 3")
        >>> [file.name for file in folder.iterdir()]
        ['numbers.txt']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield temporary
        _sync(temporary)
        if replace or not _link(temporary, path):
            os.replace(temporary, path)
    except BaseException:  # an interrupt must not leave the temporary file either
        temporary.unlink(missing_ok=True)
        raise


def _sync(path: Path) -> None:
    """Flushes a file: otherwise a power cut after its rename may leave it empty."""
    with path.open("r+b") as file:
        os.fsync(file.fileno())


def _link(temporary: Path, path: Path) -> bool:
    """Gives a file a second name unless it exists; ``False`` if links are not supported."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:
        return False
    temporary.unlink()
    return True


def write_atomic(path: str | os.PathLike[str], data: str | bytes, *, replace: bool = True) -> None:
    """Writes a whole file, or leaves the old one.

    Args:
        path: The file to write or replace; its folder is created if missing.
        data: The content. Text is written as UTF-8 with unchanged line ends.
        replace: ``False`` to keep a file that another process has written meanwhile.
    """
    with atomic_path(path, replace=replace) as temporary:
        temporary.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)


def link_or_copy(source: Path, target: Path) -> None:
    """Gives a file a second name, or copies it to another disk.

    Two names are safe because files are replaced and never modified.

    Args:
        source: The file.
        target: Must not exist; its folder is created if missing.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        with atomic_path(target) as path:
            shutil.copyfile(source, path)


@contextmanager
def new_folder(path: str | os.PathLike[str], *, exist_ok: bool = False) -> Iterator[Path]:
    """Yields a temporary folder that becomes ``path`` when the block succeeds.

    The temporary folder lies beside ``path``; its name starts with a dot. It is removed if the
    block raises.

    Args:
        path: Must not exist; its parents are created.
        exist_ok: ``True`` to keep a folder that another process has made meanwhile, and to discard
            this one.

    Raises:
        DataError: if ``path`` exists.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "new"
        >>> with new_folder(target) as temporary:
        ...     _ = (temporary / "a.txt").write_text("1")
        >>> [file.name for file in target.iterdir()]
        ['a.txt']
    """
    path = Path(path)
    if os.path.lexists(path) and not exist_ok:
        raise DataError(path, None, "exists already; valid: a new folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        temporary.mkdir()
        yield temporary
        for file in filter(Path.is_file, temporary.rglob("*")):
            _sync(file)
        try:
            temporary.rename(path)
        except OSError:
            if not (exist_ok and path.is_dir()):
                raise
    finally:  # also after an interrupt
        shutil.rmtree(temporary, ignore_errors=True)


def digest_of(*paths: Path) -> str:
    """SHA-256 of a file's content, or of the names and contents of several files.

    Args:
        *paths: The files, at least one.

    Raises:
        DataError: if one cannot be read.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.txt"
        >>> _ = path.write_text("1 2 3")
        >>> digest_of(path)[:8]
        '7c8f5059'
    """
    digests = []
    for path in paths:
        digest = hashlib.sha256()
        try:
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        except OSError as error:
            raise DataError(path, None, f"unreadable ({error})") from error
        digests.append(digest.hexdigest())
    if len(digests) == 1:
        return digests[0]
    # The names below the common folder, which may have another name elsewhere.
    root = os.path.commonpath(paths)
    lines = [f"{x} {os.path.relpath(y, root)}" for x, y in zip(digests, paths, strict=True)]
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()


def parse_json(text: str | bytes) -> Any:
    """Parses JSON, or raises ``ValueError``, also if it is nested too deeply.

    Args:
        text: the text. It is refused if a text in it is not Unicode, which no file could contain.

    Example:
        >>> parse_json('{"fps": 20}')
        {'fps': 20}
    """
    try:
        content = json.loads(text)
        if "\\u" in str(text):  # \ud800 alone is half a character
            json.dumps(content, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    return content


def read_json(path: str | os.PathLike[str], what: str) -> Any:
    """Reads a JSON file.

    Args:
        path: The file.
        what: Description of the expected content, for the message.

    Raises:
        DataError: if it is missing, damaged or nested too deeply.
    """
    try:
        return parse_json(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(Path(path), None, f"not {what} ({error})") from error


def printable(text: str, *, lines: bool = False) -> str:
    r"""Returns a text that a terminal shows and does not obey: without control characters.

    Args:
        text: From a file, perhaps.
        lines: Whether it may have several lines.

    Example:
        >>> printable("lift\x1b[2J\n")
        'lift\\x1b[2J\\n'
    """
    kept = "\n" if lines else ""
    return "".join(
        c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text
    )
