"""An explorer of a small embedding, and its page, for the tests of the explorer."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from torchrl_bmrl.reports import Explorer, Section, paper, task_colors, task_titles, write_page
from torchrl_bmrl.reports.explorer import StoredExplorer

STEPS = 21
TASKS = tuple(paper.TABLE_1)
TASK_COLORS = dict(zip(TASKS, task_colors(len(TASKS)), strict=True))
EVIL = "</script><script>document.title = 'taken'</script>"


def webp(color: tuple[int, int, int]) -> bytes:
    """A picture of one colour."""
    data = io.BytesIO()
    Image.new("RGB", (16, 16), color).save(data, "WEBP", lossless=True)
    return data.getvalue()


def make_explorer(**changes: Any) -> Explorer:
    """Six tasks of two episodes; each episode is a line from left to right, far from the others.

    The first episode of each task has a film of three pictures.
    """
    task, episode, step = (a.ravel() for a in np.mgrid[:6, :2, :STEPS])
    explorer = Explorer(
        titles=list(task_titles(TASKS).values()),
        periods=dict.fromkeys(range(6), 0.05),
        task_latent=np.stack([step / 2.0, 2.0 * task + episode], axis=1),
        task=task,
        episode=episode,
        step=step,
        distance=0.5 - step / 100,
        phase=["near" if s >= 10 else "far" for s in step],
        success=step >= 15,
        frames={(t, 0, s): webp((40 * t, 10 * s, 0)) for t in range(6) for s in (0, 10, 20)},
    )
    return replace(explorer, **changes)


def page_of(explorer: Explorer | StoredExplorer, folder: Path) -> Path:
    """Writes a page with the explorer and returns its path."""
    path = folder / "report.html"
    text = explorer.paragraphs() if isinstance(explorer, Explorer) else ()
    section = Section(heading="Explore", paragraphs=text, explorer=explorer)
    write_page(path, title="A run", facts={}, sections=[section])
    return path
