"""Stage 1: one Batch-Constrained Q-learning agent per task, from demonstrations alone."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from torchrl_bmrl.data import make_multi_task_replay_buffer, make_replay_buffer
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import BCQPolicy, ChunkPolicy
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.pipeline.learners import Agents
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import Settings
from torchrl_bmrl.pipeline.training_data import training_data
from torchrl_bmrl.rows import success_cell, write_rows
from torchrl_bmrl.run.loggers import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.training.diagnostics import (
    collapse_message,
    diagnose,
    outside_message,
    read_diagnostics,
    write_diagnostics,
)
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.update import keep_freed_memory

log = logging.getLogger(__name__)

DIAGNOSED = 128
"""Transitions on which each agent is diagnosed after every epoch."""


def stage1(run: Run) -> None:
    """Trains the agents of every task, or of the tasks in ``only``.

    Each agent is trained in its own process, or all are stacked in this process.

    Args:
        run: an open run, with demonstrations.

    Raises:
        BMRLError: naming the agents that diverged, after the others are trained.

    Example:
        >>> from torchrl_bmrl.pipeline import Settings
        >>> stage1(Run(Settings(tasks=["reach"])))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: runs/mine is not open; valid: with Run(settings) as run: ...
    """
    bcq = run.settings.bcq
    agents = {
        task if seed == 0 else f"{task}-{seed}": task
        for seed in range(bcq.seeds)
        for task in run.settings.only or run.names
    }
    stacked = bcq.stacked and len(agents) > 1
    trained = run.jobs(
        train_job,
        [agents] if stacked else [{name: task} for name, task in agents.items()],
        total=bcq.updates * len(agents),
        description="stage 1: training BCQ",
        unit="update",
    )
    if any(trained):  # a finished run says nothing new
        _log_diagnostics(run, agents)


def train_job(job: tuple[Run, dict[str, str]], report: Report) -> bool:
    """Trains agents (tasks by agent name); returns whether there was something to train."""
    run, agents = job
    bcq = run.settings.bcq
    datasets = [training_data([run.transitions(x, "train")], bcq)[0] for x in agents.values()]
    options: dict[str, Any] = {
        "batch_size": bcq.batch_size,
        "device": run.settings.device,
    }
    torch.manual_seed(run.seed("batches", *agents))  # a buffer that prefetches draws from it
    if len(agents) == 1:
        buffer = make_replay_buffer(datasets[0], **options)
    else:
        buffer = make_multi_task_replay_buffer(datasets, **options)
    return train_agents(run, agents, buffer, report, datasets=datasets)


def train_agents(
    run: Run,
    agents: dict[str, str],
    buffer: ReplayBuffer,
    report: Report,
    *,
    datasets: Sequence[TensorDictBase],
) -> bool:
    """Trains agents on samples of a buffer, or resumes from their checkpoint.

    Args:
        run: the run.
        agents: the task of each agent by the agent's name.
        buffer: samples are ``[batch]`` for one agent and ``[agents, batch]`` for several.
        report: called with the number of new updates.
        datasets: the transitions of each agent, ``[N_i]``, on which it is diagnosed.

    Returns:
        whether there was something to train.

    Raises:
        BMRLError: naming the agents that diverged, after the others are trained.
    """
    keep_freed_memory()
    settings, bcq = run.settings, run.settings.bcq
    trained = Agents(run, agents, datasets)
    trained.load()
    if trained.updates:
        log.debug("bcq %s: resumed from update %d", ", ".join(agents), trained.updates)
        report(trained.updates * len(agents))
    total = bcq.updates
    unfinished = trained.updates < total
    if unfinished:
        with ExitStack() as stack:
            loggers = {}
            for name in agents:
                logger = make_logger(settings.logger, run.folder, f"bcq_{name}", trained.updates)
                loggers[name] = logger
                stack.callback(close_logger, logger)

            samples = {
                name: _sample(run, name, data.select(*trained.loss.in_keys))
                for name, data in zip(agents, datasets, strict=True)
            }

            def check(
                update: int, metrics: dict[str, Tensor], batch: TensorDictBase, logging: bool
            ) -> None:
                for name, row in trained.check(metrics, batch, update).items():
                    log_metrics(loggers[name] if logging else None, row, update)

            def end_epoch(update: int) -> None:
                for name in trained.healthy:
                    _diagnose(run, trained, name, samples[name], loggers[name], update)
                if run.playable and bcq.eval_episodes:
                    _evaluate_epoch(run, trained, update)

            fit(
                trained.make_step(total),
                lambda: trained.sample(buffer),
                start=trained.updates,
                total=total,
                every=Every(
                    log=settings.log_interval,
                    save=settings.checkpoint_interval,
                    evaluate=bcq.updates_per_epoch,
                ),
                check=check,
                evaluate=end_epoch,
                save=trained.save,
                report=lambda updates: report(updates * len(agents)),
            )
    if trained.diverged:
        raise BMRLError("; ".join(trained.diverged.values()))
    return unfinished


def _sample(run: Run, name: str, data: TensorDictBase) -> TensorDictBase:
    """Returns the transitions on which an agent is diagnosed."""
    generator = torch.Generator().manual_seed(run.seed("diagnose", name))
    rows = torch.randperm(len(data), generator=generator)[:DIAGNOSED]
    return data[rows].to(run.settings.device)


def _diagnose(
    run: Run, trained: Agents, name: str, sample: TensorDictBase, logger: Any, update: int
) -> None:
    """Logs and saves an agent's diagnostics after an epoch."""
    count = run.settings.evaluate.num_candidates
    found = diagnose(trained.agent(name), sample, num_candidates=count)
    log_metrics(logger, found.metrics(), update)
    epoch = update // run.settings.bcq.updates_per_epoch
    path = run.agent_path(name).with_name("diagnostics.csv")
    write_diagnostics(path, found, epoch=epoch, update=update)


def _log_diagnostics(run: Run, agents: Iterable[str]) -> None:
    """Logs what the last diagnostics of all agents mean, in one line for each finding."""
    files = {name: run.agent_path(name).with_name("diagnostics.csv") for name in agents}
    found = {name: read_diagnostics(path) for name, path in files.items() if path.is_file()}
    last = {name: rows[max(rows)] for name, rows in found.items() if rows}
    # The published settings collapse, which is no fault of the run: no warning.
    if message := collapse_message(last):
        log.info("stage 1: %s", message)
    if message := outside_message(last):
        log.warning("stage 1: %s", message)


def _evaluate_epoch(run: Run, trained: Agents, update: int) -> None:
    """Plays every agent that has not diverged, for the curves."""
    epoch = update // run.settings.bcq.updates_per_epoch
    for name in trained.healthy:
        rows = trained.evaluations[name]
        rows += _play(run, trained.agents[name], trained.agent(name), epoch, update)
        write_rows(run.agent_path(name).with_name("evaluations.csv"), rows)
        trained.save_best(name, update)
        mean = fmean(row["return"] for row in rows if row["epoch"] == epoch)
        log.debug("bcq %s: mean return %.1f after epoch %d", name, mean, epoch)


def make_policy(loss: BCQLoss, settings: Settings) -> TensorDictModuleBase:
    """Returns the policy of an agent; it plays chunks if the agent proposes them."""
    policy = BCQPolicy.frozen(loss, num_candidates=settings.evaluate.num_candidates)
    chunk = settings.bcq.action_chunk
    return policy if chunk == 1 else ChunkPolicy(policy, chunk)


def _play(run: Run, task: str, loss: BCQLoss, epoch: int, update: int) -> list[dict]:
    """Plays episodes of an agent, from the same starts after every epoch."""
    seeds = [run.seed("curve", task, i) for i in range(run.settings.bcq.eval_episodes)]
    policy = make_policy(loss, run.settings).to("cpu")
    return [
        {
            "epoch": epoch,
            "update": update,
            "episode": i,
            "return": outcome.episode_return,
            "success": success_cell(outcome.success),
        }
        for i, outcome in enumerate(run.play(run.task(task), policy, seeds=seeds))
    ]
