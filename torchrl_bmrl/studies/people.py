"""Stage 1 from scripted and human demonstrations together: do the human ones help?"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from torchrl_bmrl.data import make_mixed_replay_buffer
from torchrl_bmrl.data.convert import convert, find_format
from torchrl_bmrl.data.demonstrations import read_demonstrations
from torchrl_bmrl.data.importing import copy_scaled, read_original_bounds
from torchrl_bmrl.data.options import Bounds
from torchrl_bmrl.data.source_files import files_of
from torchrl_bmrl.envs.transforms import transform_data
from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.evaluation import bootstrap_interval
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.families import tasks_of
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.collect import collect
from torchrl_bmrl.pipeline.evaluate import evaluate_once
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.stage1 import train_agents
from torchrl_bmrl.pipeline.task_files import check_playable
from torchrl_bmrl.pipeline.training_data import training_data
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import MISSING, Table
from torchrl_bmrl.rows import success_cell, write_rows
from torchrl_bmrl.run.locks import lock_run
from torchrl_bmrl.run.progress import progress
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.stops import check_stop
from torchrl_bmrl.run.workers import Report

log = logging.getLogger(__name__)

Job = tuple[Run, tuple[float, int]]
"""The run of the task alone, the human share and the training seed."""


@dataclass
class HumanSettings:
    """Settings of :func:`learn_from_people`."""

    path: str = ""  # robosuite's demo.hdf5, or another file or folder with demonstrations
    task: str = "lift"  # one of the run's tasks
    # Shares of human transitions in a batch; share 0 is always trained, for the comparison.
    shares: list[float] = setting([0.0, 0.1, 0.3], at_least=0, at_most=1, unique=True)
    training_seeds: int = setting(2, above=0)  # agents of each share
    tracking: float = setting(1.0, above=0)  # of robosuite's recordings, see docs/data.md
    folder: ClassVar[str] = "human"  # of the study, below the run's


def learn_from_people(run: Run, settings: HumanSettings) -> str:
    """Trains agents with different shares of human transitions, then writes ``human.csv``.

    All agents have the same scripted demonstrations and the same starts. They are trained in
    ``human/run``, the folder of a run of this one task. Finished parts are read back.

    Args:
        run: an open run; it needs no demonstrations.
        settings: the human demonstrations, and the agents.

    Returns:
        the table as Markdown.

    Raises:
        BMRLError: for demonstrations that cannot be trained on, or if a training diverges.
    """
    run.check_open()
    run.settings.bcq.check_single_actions("this study")
    if not settings.path:
        raise ConfigError("human.path is empty; valid: a file or folder with demonstrations")
    if settings.task not in run.names:
        raise UnknownNameError("human.task", settings.task, run.names)
    if run.settings.robot not in (None, "Sawyer") and _is_raw(settings):
        raise ConfigError(
            f"robot is {run.settings.robot} and {settings.path} holds recordings of robosuite, "
            "which are replayed by a Sawyer; valid: null or Sawyer"
        )
    shares = [0.0, *(share for share in settings.shares if share)]
    agents = [(share, seed) for share in shares for seed in range(settings.training_seeds)]
    bcq, evaluate = run.settings.bcq, run.settings.evaluate
    folder, tasks = run.folder / settings.folder, run.settings.tasks
    if isinstance(tasks, Mapping):
        tasks = {settings.task: tasks[settings.task]}
    else:
        # A family's name stands for its members. The module before it makes them known.
        of = next(x for x in tasks if settings.task in [task.name for task in tasks_of(x)])
        module, colon, _ = of.rpartition(":")
        tasks = [f"{module}{colon}{settings.task}"]
    alone = Run(replace(run.settings, run_dir=str(folder / "run"), base=None, tasks=tasks))
    check_playable(alone.tasks)
    # More shares and seeds may join the finished ones, with the same demonstrations.
    held = {name: getattr(settings, name) for name in ("path", "task", "tracking")}
    files = {"human.path": files_of(settings.path)}
    with lock_run(folder, held, files=files), alone:
        bounds: Bounds = (-1.0, 1.0)
        if alone.tasks[0].files is not None:  # else the recording, which takes long, comes last
            collect(alone)
            bounds = read_original_bounds(alone.demonstrations(settings.task)) or bounds
        _convert(settings, folder / "demonstrations.hdf5", bounds)
        collect(alone)
        alone.jobs(
            train_job,
            agents,
            total=bcq.updates * len(agents),
            description="training BCQ",
            unit="update",
        )
        parts = alone.jobs(
            evaluate_job,
            agents,
            total=evaluate.episodes * alone.horizon(alone.tasks[0]) * len(agents),
            description="evaluating",
            unit="step",
        )
    rows = [row for part in parts for row in part]
    write_rows(run.folder / "human.csv", rows)
    table = make_table(rows, run.titles[settings.task])
    section = Section(heading="Scripted and human demonstrations", tables=[table])
    write_study(run.folder, "human", section, {})
    return table.markdown()


def _is_raw(settings: HumanSettings) -> bool:
    return find_format(Path(settings.path)) == "robosuite"


def _convert(settings: HumanSettings, path: Path, bounds: Bounds) -> None:
    """Writes the human demonstrations in robomimic's layout, if the file is not there."""
    if path.exists():
        return
    with progress(None, "converting", "episode") as bar:

        def report(episodes: int) -> None:
            bar.update(episodes)
            check_stop()

        if _is_raw(settings):
            relabel: dict[str, Any] = {"task": settings.task, "tracking": settings.tracking}
            done = convert(settings.path, path, to="robomimic", report=report, **relabel)
        else:
            done = copy_scaled(settings.path, path, bounds=bounds, report=report)
    for note in done.notes:
        log.warning("%s: %s", settings.path, note)


def train_job(job: Job, report: Report) -> None:
    """Trains the agent of one share and training seed."""
    run, (share, seed) = job
    (task,) = run.tasks
    scripted = run.transitions(task.name, "train")
    raw = read_demonstrations(run.folder.parent / "demonstrations.hdf5", task, index=0)
    human = transform_data(raw, task, run.statistics).select(*scripted.keys(True, True))
    parts, weights = training_data([scripted, human], run.settings.bcq), [1 - share, share]
    buffer = make_mixed_replay_buffer(
        parts,
        weights=weights,
        batch_size=run.settings.bcq.batch_size,
        device=run.settings.device,
    )
    agents = {f"{task.name}-human{share:g}-{seed}": task.name}
    used = [data for data, weight in zip(parts, weights, strict=True) if weight]
    train_agents(run, agents, buffer, report, datasets=[torch.cat(used)])


def evaluate_job(job: Job, report: Report) -> list[dict[str, Any]]:
    """Episodes of one agent."""
    run, (share, seed) = job
    (task,), policy = run.tasks, f"human{share:g}-{seed}"
    path = run.agent_path(f"{task.name}-{policy}")

    def play(seeds: list[int]) -> list[EpisodeOutcome]:
        count = run.settings.evaluate.num_candidates
        agent = BCQPolicy.frozen(run.teacher(f"{task.name}-{policy}"), num_candidates=count)
        return run.play(task, agent, seeds=seeds, report=report)

    return [
        {
            "share": share,
            "training_seed": seed,
            "episode": row.episode,
            "success": success_cell(row.success),
            "return": row.episode_return,
        }
        for row in evaluate_once(run, task.name, policy, play, of=[path], report=report)
    ]


def make_table(rows: Sequence[Mapping[str, Any]], title: str) -> Table:
    """One line per share, with the difference from share 0 on the same starts.

    Args:
        rows: episodes; the first share is 0.
        title: of the task.
    """

    def column(share: float, key: str) -> list[Any]:
        return [row[key] for row in rows if row["share"] == share]

    lines, without = [], np.array(column(0.0, "return"))
    for share in dict.fromkeys(row["share"] for row in rows):
        returns, successes = np.array(column(share, "return")), column(share, "success")
        success = MISSING if "" in successes else f"{sum(successes)} of {len(successes)}"
        line = [f"{share:.0%}", f"{returns.mean():.1f}", success]
        if share == 0:
            lines.append((*line, "", "", ""))
            continue
        difference = returns - without
        low, high = bootstrap_interval(difference, strata=column(share, "training_seed"))
        verdict = "helped" if low > 0 else "hurt" if high < 0 else "no difference to be seen"
        if len(difference) < 10:
            verdict = "too few episodes to tell"
        interval = f"{low:+.1f} to {high:+.1f}"
        lines.append((*line, f"{difference.mean():+.1f}", interval, verdict))
    return Table(
        title=f"{title} from scripted and human demonstrations",
        caption=(
            "BCQ agents whose batches contain a share of human transitions. Difference: of the "
            "return from that of share 0 on the same starts, with a 95% bootstrap interval over "
            "the episodes of these agents, not over further trainings."
        ),
        header=("Human share", "Return", "Success", "Difference", "95% interval", "Human data"),
        rows=lines,
    )
