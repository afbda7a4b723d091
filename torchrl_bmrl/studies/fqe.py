"""Fitted Q evaluation of a series of stage-1 agents, compared with their true returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.data import make_replay_buffer
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation import rank_correlation
from torchrl_bmrl.evaluation.fitted_q import estimate_return
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.learners import Agents
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.task_files import check_playable
from torchrl_bmrl.pipeline.training_data import training_data
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import Table
from torchrl_bmrl.rows import finite, read_rows, whole, write_rows
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.training.checkpoint import save_checkpoint
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.update import keep_freed_memory

COLUMNS: dict[str, Callable[[str], Any]] = {
    "task": str,
    "updates": whole,
    "estimate": finite,
    "return": finite,
    "success": lambda text: finite(text) if text else None,
}


@dataclass
class FQESettings:
    """Settings of :func:`fqe`."""

    # Numbers of updates after which an agent is saved and evaluated.
    checkpoints: list[int] = setting([100, 250, 500, 1000, 2000, 4000], above=0, unique=True)
    updates: int = setting(3000, above=0)  # of each fitted Q evaluation
    tau: float = setting(0.1, above=0, at_most=1)  # of its target network
    num_candidates: int = setting(10, above=0)  # of the policies that are evaluated
    folder: ClassVar[str] = "fqe"  # of the study, below the run's


def fqe(run: Run, settings: FQESettings) -> str:
    """Evaluates a series of agents without and with the simulator, then writes ``fqe.csv``.

    Stage 1 trains an agent for each task, which is saved after each number of updates of the
    series. Fitted Q evaluation estimates the return of each from the training demonstrations; then
    each plays the evaluation's episodes. Finished parts are read back.

    Args:
        run: an open run with demonstrations.
        settings: the series, and the evaluation.

    Returns:
        the table as Markdown.

    Raises:
        BMRLError: if demonstrations are missing, a task has no environment, or a training diverges.
    """
    series = settings.checkpoints
    if len(series) < 2 or series != sorted(series):
        raise ConfigError(f"fqe.checkpoints is {series}; valid: at least two, from low to high")
    run.check_open()
    run.settings.bcq.check_single_actions("fitted Q evaluation")
    check_playable(run.tasks)
    run.statistics  # noqa: B018 (missing demonstrations are found before anything is written)
    open_run(run.folder / settings.folder, asdict(settings))
    run.jobs(
        train_job,
        [(name, series) for name in run.names],
        total=series[-1] * len(run.names),
        description="training the series",
        unit="update",
    )
    jobs = [(name, updates, settings) for name in run.names for updates in series]
    rows = run.jobs(
        evaluate_job,
        jobs,
        total=sum(_units(run, name, settings) for name, *_ in jobs),
        description="evaluating without and with the simulator",
        unit="step",
    )
    write_rows(run.folder / "fqe.csv", rows)
    table = make_table(rows, run.titles)
    write_study(run.folder, "fqe", Section(heading="Fitted Q evaluation", tables=[table]), {})
    return table.markdown()


def _checkpoint(run: Run, name: str, updates: int) -> Path:
    """The agent of a task after a number of updates."""
    return run.folder / FQESettings.folder / name / f"{updates}.safetensors"


def _units(run: Run, name: str, settings: FQESettings) -> int:
    """Updates and steps of one evaluation, for progress."""
    return settings.updates + run.settings.evaluate.episodes * run.horizon(run.task(name))


def train_job(job: tuple[Run, tuple[str, list[int]]], report: Report) -> None:
    """Trains a task's agent as stage 1 does and saves it at each number of updates."""
    run, (name, series) = job
    if all(_checkpoint(run, name, updates).exists() for updates in series):
        report(series[-1])
        return
    keep_freed_memory()
    settings = run.settings
    (data,) = training_data([run.transitions(name, "train")], settings.bcq)
    buffer = make_replay_buffer(data, batch_size=settings.bcq.batch_size, device=settings.device)
    agents = Agents(run, {name: name}, [data])
    step = agents.make_step(series[-1])

    def check(
        update: int, metrics: dict[str, Tensor], batch: TensorDictBase, logging: bool
    ) -> None:
        agents.check(metrics, batch, update)

    def save(update: int) -> None:
        if update in series:  # not where the run was asked to stop
            agents.updates = update
            state = {"module": agents.loss.state_dict()}
            save_checkpoint(_checkpoint(run, name, update), state, agents.metadata(name))

    for start, end in pairwise([0, *series]):
        fit(
            step,
            lambda: agents.sample(buffer),
            start=start,
            total=end,
            every=Every(log=end, save=end),
            check=check,
            save=save,
            report=report,
        )


def evaluate_job(job: tuple[Run, tuple[str, int, FQESettings]], report: Report) -> dict[str, Any]:
    """Computes the estimate and the true return of one agent, or loads their file."""
    run, (name, updates, settings) = job
    (row,) = run.once(
        f"{settings.folder}/{name}/{updates}.csv",
        partial(read_rows, columns=COLUMNS, expected=[{"task": name, "updates": updates}]),
        lambda path: write_rows(path, [_evaluate(run, name, updates, settings, report)]),
        skipped=lambda: report(_units(run, name, settings)),
        of=[_checkpoint(run, name, updates)],
    )
    return row


def _evaluate(
    run: Run, name: str, updates: int, settings: FQESettings, report: Report
) -> dict[str, Any]:
    """Computes the estimate and the true return of one agent."""
    keep_freed_memory()
    loss = run.teacher(name, _checkpoint(run, name, updates))
    policy = BCQPolicy.frozen(loss, num_candidates=settings.num_candidates)
    data, bcq = run.transitions(name, "train"), run.settings.bcq
    # The same for all agents of a task, so that only the policies make their estimates differ.
    torch.manual_seed(run.seed("fqe", name))
    estimate = estimate_return(
        policy,
        data,
        updates=settings.updates,
        gamma=bcq.gamma,
        tau=settings.tau,
        batch_size=bcq.batch_size,
        num_cells=bcq.num_cells,
        device=run.settings.device,
        where=f"fitted Q evaluation of {name}",
        report=report,
    )
    seeds = [run.seed("evaluate", name, i) for i in range(run.settings.evaluate.episodes)]
    outcomes = run.play(run.task(name), policy, seeds=seeds, report=report)
    successes = [outcome.success for outcome in outcomes if outcome.success is not None]
    return {
        "task": name,
        "updates": updates,
        "estimate": round(estimate, 6),
        "return": round(float(np.mean([outcome.episode_return for outcome in outcomes])), 4),
        "success": round(float(np.mean(successes)), 4) if successes else "",
    }


def make_table(rows: Sequence[Mapping[str, Any]], titles: Mapping[str, str]) -> Table:
    """One line per task, and one for all.

    Args:
        rows: the agents of each task, in the order of their updates.
        titles: of the tasks by name.
    """

    def line(title: str, names: Sequence[str]) -> tuple[str, ...]:
        parts = [[row for row in rows if row["task"] == name] for name in names]
        mine = [row for part in parts for row in part]
        labels = [row["task"] for row in mine]
        estimates, returns = ([row[key] for row in mine] for key in ("estimate", "return"))
        found = rank_correlation(estimates, returns, groups=labels)
        chosen = [max(part, key=lambda row: row["estimate"]) for part in parts]
        best = [max(row["return"] for row in part) for part in parts]
        last = [part[-1]["return"] for part in parts]
        means = (np.mean(x) for x in (returns, best, last, [row["return"] for row in chosen]))
        picked = str(chosen[0]["updates"]) if len(names) == 1 else ""
        return title, str(found), *(f"{mean:.1f}" for mean in means), picked

    series = ", ".join(f"{n:,}" for n in sorted({row["updates"] for row in rows}))
    return Table(
        title="Fitted Q evaluation beside the true returns",
        caption=(
            f"The agents of stage 1 after {series} updates, for each task. Rank correlation: "
            "Spearman's, between the estimates from the demonstrations and the mean returns on the "
            "evaluation's starts, with a 95% bootstrap interval over the agents; for all tasks the "
            "mean over the tasks. Mean, Best, Last: mean return of all agents, of the best and of "
            "the last one. Chosen: that of the agent with the highest estimate, and its updates."
        ),
        header=("Task", "Rank correlation", "Mean", "Best", "Last", "Chosen", "Chosen after"),
        rows=[
            *(line(title, [name]) for name, title in titles.items()),
            *([line("All", list(titles))] if len(titles) > 1 else []),
        ],
    )
