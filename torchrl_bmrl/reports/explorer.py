"""The embedding explorer: an interactive plot in which each point shows its moment and picture."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.reports.drawing import plane, task_colors
from torchrl_bmrl.reports.tables import MISSING

Moment = tuple[int, int, int]
"""Class index, episode within the task, step within the episode."""


@dataclass(frozen=True, kw_only=True)
class Explorer:
    """Transitions to explore, one per row, and pictures of some of them.

    Args:
        titles: Titles of the tasks by class index.
        task_latent: Embeddings m, shape ``(N, d)``, N of at least 1; for d > 2 their first two
            principal components are shown, and the page says so.
        task: Class index, shape ``(N,)``.
        episode: Episode within its task, shape ``(N,)``.
        step: Step within its episode, shape ``(N,)``.
        distance: Distance to the goal, shape ``(N,)``, [m]; NaN where unknown.
        phase: Names of the expert's phases, shape ``(N,)``; ``""`` where unknown.
        success: Whether the task's goal was met after the step, shape ``(N,)``; ``None`` where
            unknown.
        frames: WebP pictures by class index, episode and step.
        note: Why there are no pictures.
        periods: Duration of a step [s] by class index; if it is missing, times are shown in steps.

    Raises:
        BMRLError: if there is no row, a shape does not fit, an embedding or a distance is infinite,
            a class index has no title, a moment occurs twice, or a picture belongs to no row.

    Example:
        >>> explorer = Explorer(
        ...     titles=["Lift"],
        ...     task_latent=np.array([[0.5, 1.5]]),
        ...     task=np.array([0]),
        ...     episode=np.array([0]),
        ...     step=np.array([0]),
        ...     distance=np.array([0.1]),
        ...     phase=["descend"],
        ...     success=np.array([False]),
        ... )
        >>> "descend" in explorer.html()
        True
    """

    titles: Sequence[str]
    task_latent: NDArray[Any]
    task: NDArray[np.integer[Any]]
    episode: NDArray[np.integer[Any]]
    step: NDArray[np.integer[Any]]
    distance: NDArray[np.floating[Any]]
    phase: Sequence[str]
    success: NDArray[Any]
    frames: Mapping[Moment, bytes] = field(default_factory=dict)
    note: str = ""
    periods: Mapping[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.task_latent.ndim != 2 or 0 in self.task_latent.shape:
            raise BMRLError(f"task_latent must have shape (N, d), got {self.task_latent.shape}")
        expected = (len(self.task_latent),)
        for name in ("task", "episode", "step", "distance", "phase", "success"):
            if (shape := np.shape(getattr(self, name))) != expected:
                raise BMRLError(f"{name} must have shape {expected}, got {shape}")
        if not np.isfinite(self.task_latent).all():
            raise BMRLError("task_latent must be finite; it contains NaN or infinite values")
        if np.isinf(self.distance).any():
            raise BMRLError("distance must be finite, or NaN where unknown; it is infinite")
        if not ((self.task >= 0) & (self.task < len(self.titles))).all():
            raise BMRLError(f"task must lie in [0, {len(self.titles)}), got {np.unique(self.task)}")
        moments = set(
            zip(self.task.tolist(), self.episode.tolist(), self.step.tolist(), strict=True)
        )
        if len(moments) < len(self.task):
            raise BMRLError("step must occur once in an episode; some do more often")
        if lost := sorted(set(self.frames) - moments):
            raise BMRLError(f"frames must belong to a row; {lost[0]} does not")

    def html(self) -> str:
        """Returns the explorer as HTML: markup, data and script; all text from data is escaped."""
        return StoredExplorer(content=self._content()).html()

    def _content(self) -> dict[str, Any]:
        """Returns the data that the script reads."""
        points, note = plane(self.task_latent)
        axis = "principal component" if "principal" in note else "m"
        phases = sorted(set(self.phase))
        # Sorted, so that the order in which the transitions were given has no effect.
        order = np.lexsort((self.step, self.episode, self.task))
        keys = np.stack([self.task, self.episode], axis=1)[order]
        starts = np.flatnonzero(np.append(True, (np.diff(keys, axis=0) != 0).any(axis=1)))
        pictures: dict[tuple[int, int], dict[str, str]] = {}
        for (task, episode, step), picture in sorted(self.frames.items()):
            text = base64.b64encode(picture).decode("ascii")
            pictures.setdefault((task, episode), {})[str(step)] = text
        episodes = []
        for rows in np.split(order, starts[1:]):
            task, episode = int(self.task[rows[0]]), int(self.episode[rows[0]])
            siblings = np.unique(self.episode[self.task == task])
            episodes.append(
                {
                    "task": task,
                    "number": int(np.searchsorted(siblings, episode)) + 1,
                    "of": len(siblings),
                    "step": self.step[rows].tolist(),
                    "x": _short(points[rows, 0]),
                    "y": _short(points[rows, 1]),
                    "distance": _short(self.distance[rows]),
                    "phase": [phases.index(self.phase[row]) for row in rows],
                    "success": self.success[rows].tolist(),
                    "frames": pictures.get((task, episode), {}),
                }
            )
        return {
            "description": "Scatter plot of the task embedding m of held-out transitions"
            + note.replace("\n", ": "),
            "axes": [f"{axis} 1 (no unit)", f"{axis} 2 (no unit)"],
            "tasks": [
                {"name": title, "color": color, "period": self.periods.get(i)}
                for i, (title, color) in enumerate(
                    zip(self.titles, task_colors(len(self.titles)), strict=True)
                )
            ],
            "phases": [
                {"name": name or MISSING, "color": color}
                for name, color in zip(phases, task_colors(len(phases)), strict=True)
            ],
            "note": self.note,
            "episodes": episodes,
        }

    def paragraphs(self) -> list[str]:
        """Returns instructions for the reader of the page."""
        _, note = plane(self.task_latent)
        text = [
            "Each point is the embedding m of one transition of a held-out demonstration. Point at "
            "it to see its moment; click to choose it. The line is the chosen episode, with its "
            "last ten steps in black. Play it, or move the slider, to follow it beside its film."
        ]
        if note:
            text.append(f"The embedding is {note.strip().replace(', its', '; drawn are its')}.")
        if self.frames:
            filmed = len({key[:2] for key in self.frames})
            text.append(f"{filmed} episodes have a film, rendered from their simulator states.")
        elif self.note:
            text.append(f"There are no films: {self.note}")
        return text


@dataclass(frozen=True, kw_only=True)
class StoredExplorer:
    """An explorer as its data: what the script reads, from a file or made elsewhere.

    Args:
        content: JSON-compatible data of ``explorer.js``.
        caption: Caption below it.

    Example:
        >>> StoredExplorer(content={"tasks": []}, caption="m < 1").html().count("m &lt; 1")
        1
    """

    content: Mapping[str, Any]
    caption: str = ""

    def html(self) -> str:
        """Returns the explorer as HTML: markup, data and script; all text from data is escaped."""
        # In JSON "<" occurs only in text. Escaped, no text can end the script element.
        content = json.dumps(self.content, allow_nan=False).replace("<", "\\u003c")
        script = f"(() => {{\n{_file('explorer_marks.js')}\n{_file('explorer.js')}}})();\n"
        caption = f'<p class="caption">{escape(self.caption)}</p>\n' if self.caption else ""
        return (
            f"{_file('explorer.html')}"
            f'<script type="application/json">{content}</script>\n'
            f"<script>\n{script}</script>\n{caption}</div>"
        )


def style() -> str:
    """Returns the explorer's style sheet.

    Example:
        >>> ".explorer" in style()
        True
    """
    return _file("explorer.css")


def _file(name: str) -> str:
    return files("torchrl_bmrl.reports").joinpath(name).read_text(encoding="utf-8")


def _short(values: NDArray[Any]) -> list[float | None]:
    # Five digits are more than a screen shows, and take half the space.
    return [None if np.isnan(value) else float(f"{value:.5g}") for value in values.tolist()]
