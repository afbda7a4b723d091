"""Rows of CSV files: written as a whole, and read with a check of every value."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.files import write_atomic

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


def success_cell(success: bool | None) -> int | str:
    """A success as 0 or 1; empty for a task without a definition of success."""
    return "" if success is None else int(success)


def flag(text: str) -> bool:
    """Parses a truth value, written as 0 or 1, or raises ``ValueError``."""
    return one_of("0", "1")(text) == "1"
