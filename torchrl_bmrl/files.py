"""Writes files and folders atomically, and reads JSON and CSV files with typed errors."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import re
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
        'ff4fda51'
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


_ONE = r"[-+]?(\d[\d,]*\.?\d*(e[-+]?\d+)?%?|inf|nan)"
_NUMBER = re.compile(rf"{_ONE}( \[{_ONE}, {_ONE}\])?")
_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def to_cell(value: Any) -> Any:
    """Returns a value for a CSV file that no spreadsheet takes for a formula.

    A text that begins with =, +, -, @, a tab or a carriage return gets an apostrophe before it, and
    so does one that would look like that. Numbers stay numbers, and so do their intervals.

    Args:
        value: A text or a number; :func:`from_cell` returns the same text.

    Example:
        >>> to_cell("=1+1"), to_cell("-0.5"), to_cell(-0.5), from_cell(to_cell("'=1"))
        ("'=1+1", '-0.5', -0.5, "'=1")
    """
    if not isinstance(value, str) or _NUMBER.fullmatch(value) or not _FORMULA.match(value):
        return value
    return f"'{value}"


def from_cell(text: str) -> str:
    """Returns the text that :func:`to_cell` was given."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def write_rows(path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes a whole CSV file, or leaves the old one.

    Args:
        path: The file to write or replace.
        rows: At least one; all have the same keys, which become the header.
    """
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows([{key: to_cell(x) for key, x in row.items()} for row in rows])
    write_atomic(path, buffer.getvalue())


def read_rows(
    path: str | os.PathLike[str],
    columns: Mapping[str, Callable[[str], Any]],
    expected: Sequence[Mapping[str, Any]] | None = None,
) -> list[dict[str, Any]]:
    """Reads some columns of a CSV file.

    Args:
        path: The file.
        columns: A parser for each column's texts. It raises ``ValueError`` with a description of
            valid texts, as :func:`whole`, :func:`finite` and :func:`one_of` do.
        expected: What is known of each line, by column; ``None`` for any lines.

    Returns:
        One dictionary per line.

    Raises:
        DataError: naming file, line, column and value, if the file or a column is missing, or a
            value is not valid or not expected; naming file and column, if numbers have no finite
            sum.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.csv"
        >>> write_rows(file, [{"epoch": 1, "return": 0.5, "note": "other columns are ignored"}])
        >>> read_rows(file, {"epoch": whole, "return": finite})
        [{'epoch': 1, 'return': 0.5}]
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(path, None, f"no such file; expected a CSV with {', '.join(columns)}")
    try:
        # "utf-8-sig" skips the byte order mark that spreadsheets write, which would hide a column.
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            for column in columns:
                if column not in (reader.fieldnames or ()):
                    message = f"column is missing; expected the columns {', '.join(columns)}"
                    raise DataError(path, column, message)
            rows = [parse_row(_texts(record), columns, path, reader.line_num) for record in reader]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(path, None, f"not a CSV file ({error})") from error
    for column in columns:
        try:
            math.fsum(x for row in rows if isinstance(x := row[column], float) and math.isfinite(x))
        except OverflowError:
            message = "its values add up to infinity; expected a finite sum"
            raise DataError(path, column, message) from None
    if expected is not None:
        check_rows(path, rows, expected)
    return rows


def _texts(record: Mapping[str, Any]) -> dict[str, Any]:
    return {key: from_cell(x) if isinstance(x, str) else x for key, x in record.items()}


def check_rows(
    path: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    expected: Sequence[Mapping[str, Any]],
) -> None:
    """Refuses a file's rows that are not those that its run or study writes.

    Args:
        path: The file, for the message.
        rows: As :func:`read_rows` returns them.
        expected: What is known of each, by column.

    Raises:
        DataError: naming the first that differs.
    """
    for number, (row, known) in enumerate(zip(rows, expected, strict=False), start=1):
        for column, value in known.items():
            if row[column] != value:
                message = f"{row[column]!r} in row {number}; valid: {value!r}; remove the file"
                raise DataError(Path(path), column, message)
    if len(rows) != len(expected):
        message = f"{len(rows)} rows; valid: {len(expected)}; remove the file"
        raise DataError(Path(path), None, message)


def parse_row(
    record: Mapping[str, str | None],
    columns: Mapping[str, Callable[[str], Any]],
    path: Path,
    line: int,
) -> dict[str, Any]:
    """Parses one line of a CSV file.

    Args:
        record: The texts by column; ``None`` if the line is too short.
        columns: As for :func:`read_rows`.
        path: The file, for the message.
        line: Its number, for the message.

    Raises:
        DataError: if a value is missing or not valid.
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
    """Parses an integer of at most 64 bits, or raises ``ValueError``."""
    try:
        if -(2**63) <= (value := int(text)) < 2**63:
            return value
    except ValueError:
        pass
    raise ValueError("a whole number")


def number(text: str) -> float:
    """Parses a number, which may be "nan" or "inf", or raises ``ValueError``."""
    try:
        return float(text)
    except ValueError:
        raise ValueError("a number") from None


def finite(text: str) -> float:
    """Parses a finite number, or raises ``ValueError``."""
    try:
        if math.isfinite(value := float(text)):
            return value
    except ValueError:
        pass
    raise ValueError("a finite number")


def or_nothing(text: str) -> float | str:
    """Parses a finite number or an empty text, or raises ``ValueError``."""
    return finite(text) if text else ""


def one_of(*valid: str) -> Callable[[str], str]:
    """Returns a parser that accepts these texts only."""

    def parse(text: str) -> str:
        if text not in valid:
            raise ValueError(f"one of {', '.join(valid)}")
        return text

    return parse


def flag(text: str) -> bool:
    """Parses a truth value, written as 0 or 1, or raises ``ValueError``."""
    return one_of("0", "1")(text) == "1"
