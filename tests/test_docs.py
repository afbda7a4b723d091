"""What the README and the docs show is executed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers import NO_UPDATER

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = {page: re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL) for page in PAGES}


@pytest.mark.filterwarnings(NO_UPDATER)
@pytest.mark.parametrize("page", [p for p in PAGES if BLOCKS[p]], ids=lambda p: p.stem)
def test_examples_of_a_page_run_one_after_the_other(page: Path) -> None:
    for package in re.findall(r"<!-- needs: (\w+) -->", page.read_text()):
        pytest.importorskip(package)
    namespace = {"__name__": "example"}
    for block in BLOCKS[page]:
        exec(compile(block, page.name, "exec"), namespace)


def test_readme_shows_a_loss_in_use() -> None:
    assert any("BCQLoss(" in block for block in BLOCKS[ROOT / "README.md"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_to_files_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target
