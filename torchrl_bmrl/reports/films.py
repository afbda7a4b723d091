"""Phases, successes and films of demonstrations for the explorer."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.data.demonstrations import demonstration_path, phase_names
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.data.robomimic_file import read_metadata
from torchrl_bmrl.data.sources import Source
from torchrl_bmrl.envs.rendering import render_states
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import read_json, write_atomic
from torchrl_bmrl.reports.embedding import Embeddings
from torchrl_bmrl.reports.explorer import Explorer, Moment
from torchrl_bmrl.reports.tables import task_titles
from torchrl_bmrl.run.workers import Report, run_jobs

FILMS = 2
"""Number of episodes per task with a film; more would make the page too large."""
EVERY = 5
"""Steps from one picture to the next."""


@dataclass(frozen=True, kw_only=True)
class Films:
    """Pictures of held-out demonstrations.

    Args:
        frames: WebP pictures by class index, episode and step.
        note: Why there are none.

    Example:
        >>> Films(note="egl: none.").frames
        {}
    """

    frames: Mapping[Moment, bytes] = field(default_factory=dict)
    note: str = ""


def film_demonstrations(
    data_dir: Path, tasks: Sequence[str], *, report: Report | None = None
) -> Films:
    """Renders every fifth step of each task's first two held-out demonstrations.

    Args:
        data_dir: Folder of the demonstrations, ``<task>.hdf5``.
        tasks: Names of the tasks; a task's position is its class index.
        report: Called with the number of new pictures; ``None`` shows a progress bar.

    Raises:
        DataError: if a file is missing or damaged.
        RenderError: if no graphics library works.

    Example:
        >>> film_demonstrations(Path("nowhere"), ["reach"])
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: nowhere/reach.hdf5: no such file
    """
    moments: list[Moment] = []
    scenes: list[tuple[str, NDArray[Any]]] = []
    for task, name in enumerate(tasks):
        path = demonstration_path(data_dir, name)
        with open_episodes(
            path, split="valid", observation_keys=(), extras=("states",)
        ) as episodes:
            for number, key in enumerate(list(episodes)[:FILMS]):
                episode = episodes[key]
                if "states" in episode.extras and "model_file" in episode.attributes:
                    states = episode.extras["states"][: len(episode) : EVERY]
                    moments += [(task, number, EVERY * i) for i in range(len(states))]
                    scenes.append((str(episode.attributes["model_file"]), states))
    if not scenes:
        return Films(note="the demonstrations contain no simulator states.")
    pictures = _render(scenes) if report is None else render_states(scenes, report=report)
    frames = [webp(picture) for episode in pictures for picture in episode]
    return Films(frames=dict(zip(moments, frames, strict=True)))


def write_films(path: Path, films: Films) -> None:
    """Writes films to a file, or leaves the old one."""
    frames = {
        " ".join(map(str, moment)): base64.b64encode(frame).decode("ascii")
        for moment, frame in films.frames.items()
    }
    content = {"frames": frames, "note": films.note}
    write_atomic(path, json.dumps(content, allow_nan=False) + "\n")


def read_films(path: Path) -> Films:
    """Reads films.

    Raises:
        DataError: if the file is missing or damaged.
    """
    content = read_json(path, "films; remove it")
    frames: dict[Moment, bytes] = {}
    try:
        for moment, frame in content["frames"].items():
            task, episode, step = map(int, moment.split())
            frames[task, episode, step] = base64.b64decode(frame, validate=True)
        return Films(frames=frames, note=str(content["note"]))
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DataError(path, None, f"not films ({error}); remove it") from error


def explore_demonstrations(
    data_dir: Path,
    embeddings: Embeddings,
    films: Films,
    *,
    titles: Mapping[str, str] | None = None,
) -> Explorer:
    """Makes an explorer of held-out demonstrations, with phases, successes and films.

    Phases and successes are left out if they were not recorded.

    Args:
        data_dir: Folder of the demonstrations, ``<task>.hdf5``.
        embeddings: Transitions of the demonstrations in these files' ``mask/valid``; an episode's
            number is its position there.
        films: Of the same demonstrations; pictures of other transitions are left out.
        titles: Titles by task, as in :func:`~torchrl_bmrl.reports.tables.task_titles`.

    Raises:
        DataError: if a file is missing or damaged, or lacks an episode or a step.

    Example:
        >>> zeros = np.zeros(1, dtype=int)
        >>> embeddings = Embeddings(
        ...     tasks=["reach"], task_latent=np.zeros((1, 2)), task=zeros, episode=zeros, step=zeros
        ... )
        >>> explore_demonstrations(Path("nowhere"), embeddings, Films())
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: nowhere/reach.hdf5: no such file
    """
    phase = np.full(len(embeddings.task), "", dtype=object)
    success = np.full(len(embeddings.task), None, dtype=object)
    periods: dict[int, float] = {}
    for task in np.unique(embeddings.task).tolist():
        path = demonstration_path(data_dir, embeddings.tasks[task])
        extras = ("phases", "successes")
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
                recorded = episode.extras
                if named_phases := phase_names(path, f"data/{names[number]}", episode):
                    phase[rows] = np.array(named_phases, dtype=object)[recorded["phases"][steps]]
                if "successes" in recorded:
                    success[rows] = recorded["successes"][steps] != 0
    columns = (embeddings.task, embeddings.episode, embeddings.step)
    shown = set(zip(*(column.tolist() for column in columns), strict=True))
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
        frames={moment: frame for moment, frame in films.frames.items() if moment in shown},
        note=films.note,
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
