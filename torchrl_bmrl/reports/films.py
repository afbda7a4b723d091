"""Phases, successes and films of demonstrations for the explorer."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.data.demonstrations import demonstration_path
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.data.robomimic_file import read_metadata
from torchrl_bmrl.data.sources import Source
from torchrl_bmrl.envs.rendering import render_states
from torchrl_bmrl.errors import DataError, RenderError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.reports.embedding import Embeddings
from torchrl_bmrl.reports.explorer import Explorer, Moment
from torchrl_bmrl.reports.tables import task_titles
from torchrl_bmrl.run.workers import Report, run_jobs

FILMS = 2
"""Number of episodes per task with a film; more would make the page too large."""
EVERY = 5
"""Steps from one picture to the next."""


def explore_demonstrations(
    data_dir: Path, embeddings: Embeddings, *, titles: Mapping[str, str] | None = None
) -> Explorer:
    """Makes an explorer of held-out demonstrations, with phases, successes and films.

    Phases and successes are left out if they were not recorded. Films are left out if a file has no
    simulator states, or if no graphics library works; the explorer then shows why.

    Args:
        data_dir: Folder of the demonstrations, ``<task>.hdf5``.
        embeddings: Transitions of the demonstrations in these files' ``mask/valid``; an episode's
            number is its position there.
        titles: Titles by task, as in :func:`~torchrl_bmrl.reports.tables.task_titles`.

    Raises:
        DataError: if a file is missing or damaged, or lacks an episode or a step.

    Example:
        >>> zeros = np.zeros(1, dtype=int)
        >>> embeddings = Embeddings(
        ...     tasks=["reach"], task_latent=np.zeros((1, 2)), task=zeros, episode=zeros, step=zeros
        ... )
        >>> explore_demonstrations(Path("nowhere"), embeddings)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: nowhere/reach.hdf5: no such file
    """
    phase = np.full(len(embeddings.task), "", dtype=object)
    success = np.full(len(embeddings.task), None, dtype=object)
    periods: dict[int, float] = {}
    moments: list[list[Moment]] = []
    scenes: list[tuple[str, NDArray[Any]]] = []
    for task in np.unique(embeddings.task).tolist():
        path = demonstration_path(data_dir, embeddings.tasks[task])
        extras = ("phases", "successes", "states")
        metadata = read_metadata(path)
        if fps := Source(path=path, format="robomimic", episodes={}, metadata=metadata).fps:
            periods[task] = 1.0 / fps
        with open_episodes(path, split="valid", observation_keys=(), extras=extras) as episodes:
            names = list(episodes)
            for number in np.unique(embeddings.episode[embeddings.task == task]).tolist():
                if number >= len(names):
                    raise DataError(path, "mask/valid", f"contains no episode {number}")
                episode = episodes[names[number]]
                rows = (embeddings.task == task) & (embeddings.episode == number)
                steps = embeddings.step[rows]
                if steps.max() >= len(episode):
                    raise DataError(
                        path, f"data/{names[number]}", f"contains no step {steps.max()}"
                    )
                recorded, attributes = episode.extras, episode.attributes
                if "phases" in recorded and "phase_names" in attributes:
                    phase_names = np.array(list(attributes["phase_names"]), dtype=object)
                    phase[rows] = phase_names[recorded["phases"][steps]]
                if "successes" in recorded:
                    success[rows] = recorded["successes"][steps] != 0
                if number < FILMS and "states" in recorded and "model_file" in attributes:
                    seen = np.sort(steps)[::EVERY]
                    moments.append([(task, number, step) for step in seen.tolist()])
                    scenes.append((attributes["model_file"], recorded["states"][seen]))
    frames: dict[Moment, bytes] = {}
    note = "" if scenes else "the demonstrations contain no simulator states."
    try:
        for when, pictures in zip(moments, _render(scenes), strict=True):
            frames |= {
                moment: webp(picture) for moment, picture in zip(when, pictures, strict=True)
            }
    except RenderError as error:
        note = f"{error}."
    named = task_titles(embeddings.tasks, titles)
    return Explorer(
        titles=[named[task] for task in embeddings.tasks],
        task_latent=embeddings.task_latent,
        task=embeddings.task,
        episode=embeddings.episode,
        step=embeddings.step,
        distance=embeddings.distance,
        phase=phase.tolist(),
        success=success,
        frames=frames,
        note=note,
        periods=periods,
    )


def _render(scenes: list[tuple[str, NDArray[Any]]]) -> list[NDArray[np.uint8]]:
    def job(_: None, report: Report) -> list[NDArray[np.uint8]]:
        return render_states(scenes, report=report)

    total = sum(len(states) for _, states in scenes)
    (pictures,) = run_jobs(
        job, [None], workers=1, total=total, description="rendering films", unit="picture"
    )
    return pictures


def webp(picture: NDArray[np.uint8]) -> bytes:
    """Compresses a picture ``(height, width, 3)``."""
    with needs("reports"):
        from PIL import Image

    data = io.BytesIO()
    # Half the size of a JPEG.
    Image.fromarray(picture).save(data, "WEBP", quality=75, method=4)
    return data.getvalue()
