"""Films of a run's held-out demonstrations, for the report."""

from __future__ import annotations

from pathlib import Path

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.reports.films import Films, film_demonstrations, read_films, write_films
from torchrl_bmrl.run.workers import Report


def shows_embedding(run: Run) -> bool:
    """Whether each transition has an embedding of its own, which the report then shows."""
    return run.settings.distill.task_encoder == "transition"


def films_of(run: Run, report: Report | None = None) -> Films:
    """Films of the held-out demonstrations, ``evaluation/films.json``, which are rendered once.

    Args:
        run: an open run with demonstrations.
        report: called with the number of new pictures; ``None`` shows a progress bar.
    """

    def make(path: Path) -> None:
        write_films(path, film_demonstrations(run.data_dir, run.names, report=report))

    try:
        return run.once("evaluation/films.json", read_films, make)
    except StoppedError:
        raise
    except BMRLError as error:  # without a renderer, or a mesh
        return Films(note=f"{error}.")


def film_job(job: tuple[Run, None], report: Report) -> None:
    """Renders the films, for the evaluation."""
    films_of(job[0], report)
