"""Runs all stages, one after the other."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from typing import Any

from torchrl_bmrl.files import read_json, write_atomic
from torchrl_bmrl.pipeline.collect import collect
from torchrl_bmrl.pipeline.evaluate import evaluate, evaluate_job, jobs_without_student
from torchrl_bmrl.pipeline.films import film_job, shows_embedding
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.stage1 import stage1
from torchrl_bmrl.pipeline.stage2 import stage2

log = logging.getLogger(__name__)


def _stage2(run: Run) -> None:
    """Trains the student in one worker; the others play the agents' episodes and make films."""
    plays = run.settings.workers > 1 and run.playable and run.settings.evaluate.policy is None
    beside: list[tuple[Callable[..., Any], Any]] = []
    if plays:
        beside += [(evaluate_job, job) for job in jobs_without_student(run)]
        beside += [(film_job, None)] if shows_embedding(run) else []
    stage2(run, beside=beside)


STAGES = {"collect": collect, "stage 1": stage1, "stage 2": _stage2, "evaluate": evaluate}


def two_stage(run: Run) -> str:
    """Collects demonstrations, trains both stages, evaluates, and writes the report.

    Each stage skips what an earlier call finished. With several workers the agents are evaluated
    and the report's films are rendered while the student is trained.

    Args:
        run: an open run.

    Returns:
        the table of results as Markdown, the path of the report and the time of each stage.
        ``seconds.json`` contains the times, summed over all calls.

    Raises:
        BMRLError: the errors of the stages.

    Example:
        >>> from torchrl_bmrl.pipeline import Settings
        >>> two_stage(Run(Settings(tasks=["reach"])))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: runs/mine is not open; valid: with Run(settings) as run: ...
    """
    run.check_open()
    run.settings.check_distillation(run.names)
    path = run.folder / "seconds.json"
    seconds = read_json(path, "the seconds of a run") if path.exists() else {}
    for name, stage in STAGES.items():
        started = time.monotonic()
        result = stage(run)
        # Summed over all calls; the time of a killed call is lost.
        seconds[name] = round(seconds.get(name, 0.0) + time.monotonic() - started, 1)
        write_atomic(path, json.dumps(seconds, indent=2) + "\n")
        log.debug("%s: done", name)
    times = ", ".join(f"{name} {value / 60:.1f} min" for name, value in seconds.items())
    return f"{result}\n{times}"
