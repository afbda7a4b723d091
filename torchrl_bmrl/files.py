"""Writing files so that nobody ever sees half of one."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import DataError


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, replace: bool = True) -> Iterator[Path]:
    """Yields a temporary path that becomes ``path`` when the block succeeds.

    The temporary file lies in the same folder (created if missing), so that the final rename is
    atomic; its name starts with a dot and ends in ``.tmp``, so that no pattern for finished files
    (``*.hdf5``) matches what a killed process may leave. If the block raises, the temporary file is
    removed and whatever was at ``path`` stays.

    Args:
        path: The file to write or replace.
        replace: ``False`` keeps a file that is there by then, another process's.

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
        with temporary.open("r+b") as file:
            # Without it a power cut after the rename may leave an empty file under the final name.
            os.fsync(file.fileno())
        if replace or not _link(temporary, path):
            os.replace(temporary, path)
    except BaseException:  # an interrupt must not leave the temporary file either
        temporary.unlink(missing_ok=True)
        raise


def _link(temporary: Path, path: Path) -> bool:
    """Gives a file a second name unless that is taken; ``False`` where there are no links."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError:
        return False
    temporary.unlink()
    return True


def write_atomic(path: str | os.PathLike[str], data: str | bytes, *, replace: bool = True) -> None:
    r"""Writes a whole file, or leaves the old one.

    Args:
        path: The file to write or replace; its folder is created if missing.
        data: The content; text is written as UTF-8, line ends as they are.
        replace: ``False`` keeps a file that is there by then, another process's.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "note.txt"
        >>> write_atomic(file, "good\n")
        >>> file.read_bytes()
        b'good\n'
    """
    with atomic_path(path, replace=replace) as temporary:
        temporary.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)


def link_or_copy(source: Path, target: Path) -> None:
    """Gives a file a second name, or a copy on another disk.

    A file is replaced, never changed, so it may have two names.

    Args:
        source: a file.
        target: must not exist; its folder is created if missing.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_atomic(folder / "a", "1")
        >>> link_or_copy(folder / "a", folder / "b")
        >>> (folder / "b").read_text()
        '1'
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

    It lies beside ``path``, has a leading dot and is removed if the block raises.

    Args:
        path: must not exist; its parents are created.
        exist_ok: another process may make the same folder meanwhile: it is kept, and this one's is
            dropped.

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
            with file.open("r+b") as written:
                # Without it a power cut after the rename may leave empty files in the folder.
                os.fsync(written.fileno())
        try:
            temporary.rename(path)
        except OSError:
            if not (exist_ok and path.is_dir()):
                raise
    finally:  # after an interrupt, too
        shutil.rmtree(temporary, ignore_errors=True)


def read_json(path: str | os.PathLike[str], what: str) -> Any:
    """The content of a JSON file.

    Args:
        path: The file.
        what: What it should hold, for the message.

    Raises:
        DataError: if it is missing, damaged or nested beyond reason.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.json"
        >>> write_atomic(file, "[1, 2]")
        >>> read_json(file, "two numbers")
        [1, 2]
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(Path(path), None, f"not {what} ({error})") from error


def write_rows(path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]]) -> None:
    r"""Writes rows of equal keys as CSV, or leaves the old file.

    Args:
        path: The file to write or replace.
        rows: At least one; the keys of the first are the header.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.csv"
        >>> write_rows(file, [{"epoch": 1, "return": 0.5}])
        >>> file.read_text()
        'epoch,return\n1,0.5\n'
    """
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomic(path, buffer.getvalue())


def read_rows(
    path: str | os.PathLike[str], columns: Mapping[str, Callable[[str], Any]]
) -> list[dict[str, Any]]:
    """Reads columns of a CSV file, each value through its column's parser; others are ignored.

    Args:
        path: The file.
        columns: By name, what makes a value of a text. It raises ``ValueError`` with what is valid,
            as :func:`whole`, :func:`finite` and :func:`one_of` do.

    Returns:
        One dictionary a line, in the file's order.

    Raises:
        DataError: if the file or a column is missing, or a value is not valid; the message names
            the file, line, column, value and what is valid.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.csv"
        >>> write_rows(file, [{"epoch": 1, "return": 0.5}])
        >>> read_rows(file, {"epoch": whole, "return": finite})
        [{'epoch': 1, 'return': 0.5}]
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(path, None, f"no such file; expected a CSV with {', '.join(columns)}")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            for column in columns:
                if column not in (reader.fieldnames or ()):
                    message = f"column is missing; expected the columns {', '.join(columns)}"
                    raise DataError(path, column, message)
            return [parse_row(record, columns, path, reader.line_num) for record in reader]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(path, None, f"not a CSV file ({error})") from error


def parse_row(
    record: Mapping[str, str | None],
    columns: Mapping[str, Callable[[str], Any]],
    path: Path,
    line: int,
) -> dict[str, Any]:
    """One line of a CSV file, each value through its column's parser.

    Args:
        record: The texts by column; ``None`` where the line is too short.
        columns: As for :func:`read_rows`.
        path: The file, for the message.
        line: Number of the line in it, for the message.

    Raises:
        DataError: if a value is missing or not valid.

    Example:
        >>> parse_row({"epoch": "1", "seed": "0"}, {"epoch": whole}, Path("a.csv"), 2)
        {'epoch': 1}
    """
    row = {}
    for column, parse in columns.items():
        text = record[column]
        if text is None:
            raise DataError(path, column, f"value in line {line} is missing")
        try:
            row[column] = parse(text)
        except ValueError as error:
            message = f"value in line {line} is {text!r}; expected {error}"
            raise DataError(path, column, message) from None
    return row


def whole(text: str) -> int:
    """A whole number.

    Raises:
        ValueError: if the text is none.

    Example:
        >>> whole("12")
        12
    """
    try:
        return int(text)
    except ValueError:
        raise ValueError("a whole number") from None


def number(text: str) -> float:
    """A number; not finite ones are "nan" and "inf".

    Raises:
        ValueError: if the text is none.

    Example:
        >>> number("nan")
        nan
    """
    try:
        return float(text)
    except ValueError:
        raise ValueError("a number") from None


def finite(text: str) -> float:
    """A finite number.

    Raises:
        ValueError: if the text is none.

    Example:
        >>> finite("1e-3")
        0.001
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError("a finite number")
    return value


def one_of(*valid: str) -> Callable[[str], str]:
    """A parser of texts that are one of a few; it raises ``ValueError`` for another.

    Example:
        >>> one_of("a", "b")("b")
        'b'
    """

    def parse(text: str) -> str:
        if text not in valid:
            raise ValueError(f"one of {', '.join(valid)}")
        return text

    return parse


def flag(text: str) -> bool:
    """A truth value, as 0 or 1.

    Raises:
        ValueError: if the text is neither.

    Example:
        >>> flag("1")
        True
    """
    return one_of("0", "1")(text) == "1"
