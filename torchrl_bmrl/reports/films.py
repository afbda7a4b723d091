"""What the explorer shows besides embeddings: phases, successes and films of demonstrations."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.data.demonstrations import demonstration_path
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.envs.rendering import render_states
from torchrl_bmrl.errors import DataError, RenderError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports.explorer import Explorer, Moment
from torchrl_bmrl.reports.report import Embeddings
from torchrl_bmrl.run.workers import Report, run_jobs

FILMS = 2
"""Episodes of each task that have a film: more would make the page heavy."""
EVERY = 5
"""Steps from one picture to the next: four pictures a second."""


def explore_demonstrations(data_dir: Path, embeddings: Embeddings) -> Explorer:
    """Embedded transitions of held-out demonstrations with phase, success and films.

    Phases and films are left out where a file has none of what they are made from, films also where
    no graphics library works; the explorer then says why.

    Args:
        data_dir: Folder of the demonstrations, ``<task>.hdf5``.
        embeddings: Transitions of these files' demonstrations under ``mask/valid``; an episode's
            number is its place there.

    Raises:
        DataError: if a file is missing or damaged, or lacks an episode or a step.

    Example:
        >>> zeros = np.zeros(1, dtype=int)
        >>> embeddings = Embeddings(
        ...     task_latent=np.zeros((1, 2)), task=zeros, episode=zeros, step=zeros, distance=zeros
        ... )
        >>> explore_demonstrations(Path("nowhere"), embeddings)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: nowhere/reach.hdf5: no such file
    """
    phase = np.full(len(embeddings.task), "", dtype=object)
    success = np.zeros(len(embeddings.task), dtype=bool)
    moments: list[list[Moment]] = []
    scenes: list[tuple[str, NDArray[Any]]] = []
    for task in np.unique(embeddings.task).tolist():
        path = demonstration_path(data_dir, TASKS[task])
        extras = ("phases", "successes", "states")
        with open_episodes(path, split="valid", observation_keys=(), extras=extras) as episodes:
            names = list(episodes)
            for number in np.unique(embeddings.episode[embeddings.task == task]).tolist():
                if number >= len(names):
                    raise DataError(path, "mask/valid", f"holds no episode {number}")
                episode = episodes[names[number]]
                rows = (embeddings.task == task) & (embeddings.episode == number)
                steps = embeddings.step[rows]
                if steps.max() >= len(episode):
                    raise DataError(path, f"data/{names[number]}", f"holds no step {steps.max()}")
                told = episode.extras
                if "phases" in told and "phase_names" in episode.attributes:
                    phase[rows] = np.array(list(episode.attributes["phase_names"]), dtype=object)[
                        told["phases"][steps]
                    ]
                if "successes" in told:
                    success[rows] = told["successes"][steps] != 0
                if number < FILMS and "states" in told and "model_file" in episode.attributes:
                    seen = np.sort(steps)[::EVERY]
                    moments.append([(task, number, step) for step in seen.tolist()])
                    scenes.append((episode.attributes["model_file"], told["states"][seen]))
    frames: dict[Moment, bytes] = {}
    note = "" if scenes else "the demonstrations hold no simulator states."
    try:
        for when, pictures in zip(moments, _render(scenes), strict=True):
            frames |= {
                moment: _webp(picture) for moment, picture in zip(when, pictures, strict=True)
            }
    except RenderError as error:
        note = f"{error}."
    return Explorer(
        task_latent=embeddings.task_latent,
        task=embeddings.task,
        episode=embeddings.episode,
        step=embeddings.step,
        distance=embeddings.distance,
        phase=phase.tolist(),
        success=success,
        frames=frames,
        note=note,
    )


def _render(scenes: list[tuple[str, NDArray[Any]]]) -> list[NDArray[np.uint8]]:
    def job(_: None, report: Report) -> list[NDArray[np.uint8]]:
        return render_states(scenes, report=report)

    total = sum(len(states) for _, states in scenes)
    (pictures,) = run_jobs(
        job, [None], workers=1, total=total, description="rendering films", unit="picture"
    )
    return pictures


def _webp(picture: NDArray[np.uint8]) -> bytes:
    with needs("reports"):
        from PIL import Image

    data = io.BytesIO()
    # Half of what JPEG needs.
    Image.fromarray(picture).save(data, "WEBP", quality=75, method=4)
    return data.getvalue()
