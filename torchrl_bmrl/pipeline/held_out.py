"""Evaluation without an environment: held-out losses, accuracy and fitted Q evaluation."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from functools import partial
from math import isnan, nan
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_bmrl.data.replay import check_device
from torchrl_bmrl.evaluation.fitted_q import estimate_return
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.training_data import training_data
from torchrl_bmrl.reports.tables import MISSING, Table
from torchrl_bmrl.rows import finite, number, read_rows, write_rows
from torchrl_bmrl.run.workers import Report

log = logging.getLogger(__name__)

COLUMNS: dict[str, Callable[[str], Any]] = {
    "task": str,
    "loss_generator": finite,
    "loss_qvalue": finite,
    "distance": finite,
    "accuracy": number,  # nan without a classifier
    "demonstrated": finite,
    "bcq": finite,
    "distilled": finite,
}
_PAGE = (
    "At least one task has no environment, so that no policy could be played. The losses are "
    "those of held-out demonstrations. The returns are discounted: those of the demonstrations "
    "are measured, those of the policies are estimates of fitted Q evaluation, which rank policies "
    "rather than measure them."
)


def evaluate_held_out(run: Run) -> Table:
    """Evaluates both stages on held-out demonstrations and writes ``held_out.csv``.

    Args:
        run: an open run with both stages.

    Returns:
        the numbers of every task.

    Raises:
        ConfigError: if the run's device, which the estimates are trained on, is not here.
    """
    check_device(run.settings.device)
    log.warning("some tasks have no environment: held-out losses and estimates instead of returns")
    updates = _critic_updates(run)
    rows = run.jobs(
        held_out_job,
        run.names,
        total=2 * updates * len(run.names),
        description="evaluating on held-out demonstrations",
        unit="update",
    )
    write_rows(run.folder / "held_out.csv", rows)
    return Table(
        title="Held-out demonstrations",
        caption=_PAGE,
        header=(
            "Task",
            "Generator loss",
            "Critic loss",
            "Student to teacher",
            "Accuracy of the task",
            "Return, demonstrations",
            "BCQ (estimate)",
            "Distilled (estimate)",
        ),
        rows=[
            (
                run.titles[str(row["task"])],
                *(f"{row[key]:.4g}" for key in ("loss_generator", "loss_qvalue", "distance")),
                MISSING if isnan(float(row["accuracy"])) else f"{row['accuracy']:.1%}",
                *(f"{row[key]:.2f}" for key in ("demonstrated", "bcq", "distilled")),
            )
            for row in rows
        ],
    )


def held_out_job(job: tuple[Run, str], report: Report) -> dict[str, str | float]:
    """Computes the numbers of one task, or loads their file."""
    run, name = job
    (row,) = run.once(
        f"evaluation/{name}-held_out.csv",
        partial(read_rows, columns=COLUMNS, expected=[{"task": name}]),
        lambda path: write_rows(path, [_held_out(run, name, report)]),
        skipped=lambda: report(2 * _critic_updates(run)),
        of=[run.agent_path(name), run.student_path],
    )
    return row


def _held_out(run: Run, name: str, report: Report) -> dict[str, str | float]:
    """Computes the numbers of one task."""
    train, valid = (run.transitions(name, split) for split in ("train", "valid"))
    index, settings = run.names.index(name), run.settings
    learned = training_data([train, valid], settings.bcq)[1]  # as the critics know it
    loss, (student, metadata) = run.teacher(name), run.student()
    torch.manual_seed(run.seed("held out", name))
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No target network updater")  # nothing is trained here
        generator, qvalue = (f(learned.copy())[0] for f in (loss.generator_loss, loss.qvalue_loss))
    teacher = BCQPolicy.frozen(loss, num_candidates=loss.num_candidates)
    policy = student.policy(num_candidates=loss.num_candidates, latent_clip=metadata["latent_clip"])

    def with_prototype(data: TensorDictBase) -> TensorDictBase:
        """Adds the task's prototype as m, also under ``"next"``."""
        m = student.prototypes[index].expand(len(data), -1)
        after = data["next"].copy().set("task_latent", m)
        return data.copy().set("task_latent", m).set("next", after)

    acts = [
        each(data.select(*each.in_keys))["action"]
        for each, data in ((teacher, valid), (policy, with_prototype(valid)))
    ]
    options: dict[str, Any] = {
        "updates": _critic_updates(run),
        "gamma": settings.bcq.gamma,
        "num_cells": settings.bcq.num_cells,
        "device": settings.device,
        "report": report,
    }
    estimates = {}
    for key, each, data in (("bcq", teacher, train), ("distilled", policy, with_prototype(train))):
        torch.manual_seed(run.seed("held out", name, "critic"))
        estimates[key] = estimate_return(each, data, where=f"{key} on {name}", **options)
    return {
        "task": name,
        "loss_generator": generator.item(),
        "loss_qvalue": qvalue.item(),
        "distance": (acts[0] - acts[1]).norm(dim=-1).mean().item(),
        "accuracy": nan if metadata["accuracy"] is None else student.accuracy(valid),
        "demonstrated": _discounted_return(train, settings.bcq.gamma),
        **estimates,
    }


def _critic_updates(run: Run) -> int:
    """Updates of fitted Q evaluation: 3,000, or as many as stage 1 has if these are fewer."""
    bcq = run.settings.bcq
    return min(3000, bcq.updates)


def _discounted_return(data: TensorDictBase, gamma: float) -> float:
    """Mean over the episodes of the discounted sum of their rewards."""
    discounted = data["next", "reward"].squeeze(-1) * gamma ** data["step"]
    return (discounted.sum() / len(data["episode"].unique())).item()
