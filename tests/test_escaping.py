"""Text from files is shown and not obeyed: on a terminal, in Markdown, CSV, HTML and figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.files import printable
from torchrl_bmrl.rows import number, read_rows, write_rows

FORMULA = "=1+1"
TEXTS = [FORMULA, "+a", "-a", "@a", "\ta", "'=a", "''-a", "'a", "a", "", "-1-2", "–"]
NUMBERS = ["-0.5", "+3.4%", "-1e-05", "-inf", "-1,234.5", "-1.2% [-3.0, +0.5]", "[-1.0, 2.0]"]


def cells(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


@pytest.mark.parametrize("text", TEXTS)
def test_no_text_of_a_csv_file_is_a_formula_and_all_are_read_back(
    tmp_path: Path, text: str
) -> None:
    path = tmp_path / "a.csv"
    write_rows(path, [{"name": text, "value": -1.5, "text_of_number": "-1.50000"}])
    ((name, *numbers),) = cells(path)[1:]
    assert not name.startswith(tuple("=+-@\t\r"))
    assert numbers == ["-1.5", "-1.50000"]
    assert read_rows(path, {"name": str, "value": number}) == [{"name": text, "value": -1.5}]


def test_results_with_any_names_are_read_back_unchanged(tmp_path: Path) -> None:
    row: dict[str, Any] = {"seed": 0, "episode": 1, "episode_return": -1.5, "success": None}
    rows = [ResultRow(task=text, policy=f"{text}x", **row) for text in TEXTS if text]
    write_results(tmp_path / "results.csv", rows)
    assert read_results(tmp_path / "results.csv") == rows
    assert FORMULA not in {cell for line in cells(tmp_path / "results.csv") for cell in line}


def table_of(*texts: str) -> Any:
    pytest.importorskip("scipy")
    from torchrl_bmrl.reports.tables import Table

    first = texts[0]
    rows = [list(texts)]
    return Table(title=f"T {first}", caption=f"C {first}", header=[first] * len(texts), rows=rows)


def test_a_table_for_spreadsheets_has_numbers_and_no_formulas() -> None:
    table = table_of(*TEXTS, *NUMBERS)
    header, row = csv.reader(io.StringIO(table.csv()))
    assert not any(cell.startswith(tuple("=+-@\t\r")) for cell in header)
    assert row[len(TEXTS) :] == NUMBERS


def test_a_table_in_markdown_has_its_lines_and_cells_and_no_other_elements() -> None:
    odd = "<img src=x> | [a](b) \n\n# b \x1b[2J ![c](d)"
    text = table_of(odd, "1").markdown()
    plain = table_of("a", "1").markdown()
    assert len(text.splitlines()) == len(plain.splitlines())
    assert "<" not in text
    # The caption is Markdown of the caller and may have links; titles and cells are of files.
    caption = text.splitlines()[2]
    assert "](" in caption
    assert "](" not in text.replace(caption, "", 1)
    assert text.replace("\n", "").isprintable()
    line = text.splitlines()[-1]
    assert line.count("|") - line.count("\\|") == plain.splitlines()[-1].count("|")


@pytest.mark.parametrize(
    "text", ["a\x1b[31mb", "a\x07", "a\r\nerror: b", "a\u202eb", "\ud800", "é"]
)
def test_a_terminal_gets_no_control_characters(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    shown.encode()
    if text.isprintable():
        assert shown == text


def test_errors_and_log_messages_are_printed_without_control_characters(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from torchrl_bmrl.run.command_line import exit_codes
    from torchrl_bmrl.run.logs import write_line

    with pytest.raises(SystemExit), exit_codes():
        raise DataError("a.hdf5", "mask/\x1b[2J", "b\nerror: c")
    write_line("task \x1b]0;title\x07\nsecond line")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(map(str.isprintable, lines))


def test_the_check_of_a_file_prints_names_without_control_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    h5py = pytest.importorskip("h5py")
    from torchrl_bmrl.data.__main__ import main
    from torchrl_bmrl.data.episodes import Episode
    from torchrl_bmrl.data.robomimic import write_episodes

    x = {"x": np.zeros((2, 1)), "y\x1b[2J": np.ones((2, 1))}
    episode = Episode(
        observations=x,
        next_observations=x,
        actions=np.zeros((2, 1)),
        rewards=np.zeros(2),
        terminated=np.zeros(2, bool),
        extras={"successes": np.zeros(2, bool)},
    )
    path = tmp_path / "a.hdf5"
    write_episodes(path, [episode], env_args={}, masks={"m\x1b[2J": [0]})
    with h5py.File(path, "a") as file:
        file["odd\x1b]0;a\x07"] = 1
        file["mask/bad\x1b[2J"] = np.array([b"none\x1b[2J"])
    main(["check", str(path)])
    with pytest.raises(SystemExit):
        main(["check", str(path), "--split", "x\x1b[2J"])
    out, err = capsys.readouterr()
    assert "y\\x1b[2J" in out
    assert "bad\\x1b[2J" in err
    assert all(map(str.isprintable, [*out.splitlines(), *err.splitlines()]))


def test_a_name_with_dollar_signs_is_drawn() -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("scipy")
    from matplotlib.figure import Figure

    from torchrl_bmrl.reports.drawing import png

    def drawn(change: Callable[[Any], object]) -> bytes:
        axes = (figure := Figure()).subplots()
        change(axes)
        return png(figure)

    assert drawn(lambda axes: axes.set_title("$\\no such formula$ $"))
    assert drawn(lambda axes: axes.semilogy([1, 1000]))
