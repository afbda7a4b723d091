"""Studies of a finished run: each saves its table and figures, and the page shows them all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.files import read_json, write_atomic
from torchrl_bmrl.reports.explorer import StoredExplorer
from torchrl_bmrl.reports.page import Picture, Section
from torchrl_bmrl.reports.tables import Table

_PNG = b"\x89PNG"
"""First bytes of every PNG."""


def write_study(
    run_dir: str | os.PathLike[str], name: str, section: Section, figures: Mapping[str, Picture]
) -> None:
    """Saves a study's part of the page in a run folder.

    It writes ``tables/<name>.{md,csv}``, ``figures/<figure>.png``, ``figures/<name>.json`` with the
    explorer's data and, last, ``studies/<name>.json``, which the report reads. Each file is written
    atomically.

    Args:
        run_dir: Run folder.
        name: Name of the study and of its files.
        section: Heading, text, one table and, if there is one, a stored explorer.
        figures: Pictures by file name.

    Example:
        >>> import tempfile
        >>> table = Table(title="T", caption="C", header=("a",), rows=[("1",)])
        >>> folder = tempfile.mkdtemp()
        >>> write_study(folder, "noise", Section(heading="Noise", tables=[table]), {})
        >>> [section.heading for section in read_studies(folder)]
        ['Noise']
    """
    run_dir = Path(run_dir)
    (table,) = section.tables
    write_atomic(run_dir / "tables" / f"{name}.md", table.markdown())
    write_atomic(run_dir / "tables" / f"{name}.csv", table.csv())
    for figure, picture in figures.items():
        write_atomic(run_dir / "figures" / f"{figure}.png", picture.png)
    if isinstance(section.explorer, StoredExplorer):
        data = json.dumps(asdict(section.explorer), allow_nan=False)
        write_atomic(run_dir / "figures" / f"{name}.json", data + "\n")
    content = {
        "heading": section.heading,
        "explorer": section.explorer is not None,
        "paragraphs": list(section.paragraphs),
        "table": asdict(table),
        "pictures": [
            {"file": f"{figure}.png", "alt": picture.alt, "caption": picture.caption}
            for figure, picture in figures.items()
        ],
    }
    write_atomic(run_dir / "studies" / f"{name}.json", json.dumps(content, indent=1) + "\n")


def read_studies(run_dir: str | os.PathLike[str]) -> list[Section]:
    """Reads the sections of all studies in a run folder, sorted by name.

    Raises:
        DataError: if a file is not a study's, or one of its figures is missing.
    """
    return [_read(path) for path in sorted(Path(run_dir).glob("studies/*.json"))]


def _read(path: Path) -> Section:
    content = read_json(path, "the results of a study; remove it")
    try:
        pictures = [
            Picture(
                # Only the file name is used, so that a foreign file cannot point out of the folder.
                png=_read_png(_figure(path, Path(picture["file"]).name)),
                alt=picture["alt"],
                caption=picture["caption"],
            )
            for picture in content["pictures"]
        ]
        explorer = None
        if content.get("explorer"):  # studies of earlier versions say nothing of it
            figure = _figure(path, path.name)
            explorer = StoredExplorer(**read_json(figure, "the explorer of a study"))
        return Section(
            heading=content["heading"],
            explorer=explorer,
            paragraphs=content["paragraphs"],
            tables=[Table(**content["table"])],
            pictures=pictures,
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(path, None, f"not the results of a study ({error}); remove it") from error


def _figure(study: Path, name: str) -> Path:
    """A file among the figures of a run folder: the page would show what a link leads to."""
    file = study.parents[1] / "figures" / name
    own = study.parents[1].resolve() / "figures" / name
    if file.resolve() != own or not file.is_file():
        kind = "a link or a device" if os.path.lexists(file) else "missing"
        raise DataError(file, None, f"{kind}; valid: a file in the run folder")
    return file


def _read_png(file: Path) -> bytes:
    content = file.read_bytes()
    if not content.startswith(_PNG):
        raise DataError(file, None, "not a PNG picture; valid: one, as the study wrote it")
    return content
