"""What a study keeps is what the page shows."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation import ResultRow, write_results
from torchrl_bmrl.reports import Picture, Section, Table, read_studies, write_report, write_study

PICTURE = Picture(png=b"\x89PNG picture", alt="A curve", caption="Up is <better>")
SECTION = Section(
    heading="A study",
    paragraphs=["One & two."],
    tables=[Table(title="T", caption="C", header=("Name", "Share"), rows=[("a|b", "50%")])],
)


def test_a_study_that_is_read_equals_what_was_written(tmp_path: Path) -> None:
    write_study(tmp_path, "noise", SECTION, {"noise_curve": PICTURE})
    (section,) = read_studies(tmp_path)
    assert section.heading == SECTION.heading
    assert list(section.paragraphs) == list(SECTION.paragraphs)
    assert list(section.pictures) == [PICTURE]
    (table,) = section.tables
    assert (
        table.markdown()
        == SECTION.tables[0].markdown()
        == (tmp_path / "tables" / "noise.md").read_text()
    )
    with (tmp_path / "tables" / "noise.csv").open() as file:
        assert list(csv.reader(file)) == [["Name", "Share"], ["a|b", "50%"]]


def test_a_run_without_studies_has_none(tmp_path: Path) -> None:
    assert read_studies(tmp_path) == []


def test_the_page_shows_every_study_and_escapes_it(tmp_path: Path) -> None:
    row = ResultRow(task="reach", policy="bcq", seed=0, episode=0, episode_return=1, success=True)
    write_results(tmp_path / "results.csv", [row])
    for name in ("b", "a"):
        write_study(tmp_path, name, SECTION, {f"{name}_curve": PICTURE})
    page = write_report(tmp_path, default_source="prototype", facts={}).read_text()
    assert page.count("<h2>A study</h2>") == 2
    assert page.count("Up is &lt;better&gt;") == 2
    assert "One &amp; two." in page


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: "{",
        lambda content: json.dumps({**content, "table": {"title": "T"}}),
        lambda content: json.dumps({key: content[key] for key in content if key != "heading"}),
        lambda content: json.dumps({**content, "pictures": [{"file": "other.png"}]}),
    ],
    ids=["no JSON", "half a table", "no heading", "no figure"],
)
def test_a_damaged_study_is_named(tmp_path: Path, damage: Any) -> None:
    write_study(tmp_path, "noise", SECTION, {})
    path = tmp_path / "studies" / "noise.json"
    path.write_text(damage(json.loads(path.read_text())))
    with pytest.raises(DataError, match=r"noise\.json: not the results of a study"):
        read_studies(tmp_path)


def test_a_study_leads_to_no_file_outside_its_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    write_study(run, "noise", SECTION, {"curve": PICTURE})
    (tmp_path / "secret.png").write_bytes(b"secret")
    path = run / "studies" / "noise.json"
    path.write_text(path.read_text().replace("curve.png", "../../secret.png"))
    with pytest.raises(DataError):
        read_studies(run)


@pytest.mark.parametrize("kind", ["file", "folder", "device", "text"])
def test_a_picture_is_a_png_in_the_run_and_no_link(tmp_path: Path, kind: str) -> None:
    run = tmp_path / "run"
    write_study(run, "noise", SECTION, {"curve": PICTURE})
    picture = run / "figures" / "curve.png"
    (tmp_path / "outside").mkdir()
    picture.replace(tmp_path / "outside" / "curve.png")
    if kind == "file":
        picture.symlink_to(tmp_path / "outside" / "curve.png")
    elif kind == "folder":
        picture.parent.rmdir()
        picture.parent.symlink_to(tmp_path / "outside")
    elif kind == "device":
        picture.symlink_to("/dev/null")
    else:
        picture.write_text("no picture")
    with pytest.raises(
        DataError, match=r"curve\.png: (a link or a device|not a PNG picture); valid"
    ):
        read_studies(run)


def test_a_study_s_explorer_is_no_link(tmp_path: Path) -> None:
    write_study(tmp_path, "a", SECTION, {"curve": PICTURE})
    path = tmp_path / "studies" / "a.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "explorer": True}))
    (tmp_path / "secret.json").write_text("{}")
    (tmp_path / "figures" / "a.json").symlink_to(tmp_path / "secret.json")
    with pytest.raises(DataError, match=r"figures/a\.json: a link"):
        read_studies(tmp_path)
