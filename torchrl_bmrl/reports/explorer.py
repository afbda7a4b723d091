"""The embedding explorer: the part of the page where a point leads to its moment and picture."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports.figures import TASK_COLORS, _plane
from torchrl_bmrl.reports.tables import MISSING, task_name

# Unlike tasks, phases have no order of their own; grey joins for the seventh.
_PHASE_COLORS = (*TASK_COLORS.values(), "#7F7F7F")

Moment = tuple[int, int, int]
"""Class index, episode within the task, step within the episode."""


@dataclass(frozen=True, kw_only=True)
class Explorer:
    """Transitions to explore, row by row, and pictures of some of them.

    Args:
        task_latent: Embeddings m, shape ``(N, d)``, N of at least 1; of d > 2 their first two
            principal components are shown, and the page says so.
        task: Class index, shape ``(N,)``.
        episode: Episode within its task, shape ``(N,)``.
        step: Step within its episode, shape ``(N,)``.
        distance: End effector to goal, shape ``(N,)``, [m].
        phase: Name of the expert's phase, N of them; ``""`` where it is not known.
        success: Whether the task's goal was met after the step, shape ``(N,)``.
        frames: WebP pictures by class index, episode and step.
        note: Why there are no pictures, where there are none.
        period: Length of a step [s].

    Raises:
        BMRLError: if there is no row, a shape does not fit, an embedding or a distance is not
            finite, a class index is none of the tasks', a moment occurs twice, or a picture belongs
            to none.

    Example:
        >>> explorer = Explorer(
        ...     task_latent=np.array([[0.5, 1.5]]),
        ...     task=np.array([1]),
        ...     episode=np.array([0]),
        ...     step=np.array([0]),
        ...     distance=np.array([0.1]),
        ...     phase=["descend"],
        ...     success=np.array([False]),
        ... )
        >>> "descend" in explorer.html()
        True
    """

    task_latent: NDArray[Any]
    task: NDArray[np.integer[Any]]
    episode: NDArray[np.integer[Any]]
    step: NDArray[np.integer[Any]]
    distance: NDArray[np.floating[Any]]
    phase: Sequence[str]
    success: NDArray[np.bool_]
    frames: Mapping[Moment, bytes] = field(default_factory=dict)
    note: str = ""
    period: float = 0.05

    def __post_init__(self) -> None:
        if self.task_latent.ndim != 2 or 0 in self.task_latent.shape:
            raise BMRLError(f"task_latent must have shape (N, d), got {self.task_latent.shape}")
        expected = (len(self.task_latent),)
        for name in ("task", "episode", "step", "distance", "phase", "success"):
            if (shape := np.shape(getattr(self, name))) != expected:
                raise BMRLError(f"{name} must have shape {expected}, got {shape}")
        for name in ("task_latent", "distance"):
            if not np.isfinite(getattr(self, name)).all():
                raise BMRLError(f"{name} must be finite; it holds NaN or infinite values")
        if not ((self.task >= 0) & (self.task < len(TASKS))).all():
            raise BMRLError(f"task must lie in [0, {len(TASKS)}), got {np.unique(self.task)}")
        moments = set(
            zip(self.task.tolist(), self.episode.tolist(), self.step.tolist(), strict=True)
        )
        if len(moments) < len(self.task):
            raise BMRLError("step must occur once in an episode; some do more often")
        if lost := sorted(set(self.frames) - moments):
            raise BMRLError(f"frames must belong to a row; {lost[0]} does not")

    def html(self) -> str:
        """The explorer as HTML: markup, data and script, everything from data escaped."""
        # In JSON, "<" only occurs in text: written like this, no text can end the script element.
        content = json.dumps(self._content(), allow_nan=False).replace("<", "\\u003c")
        return (
            f"{_file('explorer.html')}"
            f'<script type="application/json">{content}</script>\n'
            f"<script>\n{_file('explorer.js')}</script>\n</div>"
        )

    def _content(self) -> dict[str, Any]:
        """What the script reads."""
        points, note = _plane(self.task_latent)
        axis = "principal component" if "principal" in note else "m"
        phases = sorted(set(self.phase))
        # In time order, whatever order the transitions came in.
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
                    "success": self.success[rows].astype(int).tolist(),
                    "frames": pictures.get((task, episode), {}),
                }
            )
        return {
            "description": "Scatter plot of the task embedding m of held-out transitions"
            + note.replace("\n", ": "),
            "axes": [f"{axis} 1 (no unit)", f"{axis} 2 (no unit)"],
            "tasks": [{"name": task_name(t), "color": TASK_COLORS[t]} for t in TASKS],
            "phases": [
                {"name": name or MISSING, "color": _PHASE_COLORS[i % len(_PHASE_COLORS)]}
                for i, name in enumerate(phases)
            ],
            "period": self.period,
            "note": self.note,
            "episodes": episodes,
        }

    def paragraphs(self) -> list[str]:
        """How to use it, and what must be known to read it."""
        _, note = _plane(self.task_latent)
        text = [
            "Each point is the embedding m of one transition of a held-out demonstration. Point at "
            "one to see its moment, click to choose it. The line is the chosen episode, its last "
            "half second in black; play it, or move the slider, to follow it beside its film."
        ]
        if note:
            text.append(f"The embedding is {note.strip().replace(', its', '; drawn are its')}.")
        if self.frames:
            filmed = len({key[:2] for key in self.frames})
            text.append(f"{filmed} episodes have a film, rendered from their simulator states.")
        elif self.note:
            text.append(f"There are no films: {self.note}")
        return text


def style() -> str:
    """The explorer's style sheet.

    Example:
        >>> ".explorer" in style()
        True
    """
    return _file("explorer.css")


def _file(name: str) -> str:
    return files("torchrl_bmrl.reports").joinpath(name).read_text(encoding="utf-8")


def _short(values: NDArray[Any]) -> list[float]:
    # Five digits are more than a screen shows, and half the size.
    return [float(f"{value:.5g}") for value in values.tolist()]
