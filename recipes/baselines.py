"""Baselines on the same demonstrations: what do the two stages buy?

    python recipes/baselines.py run_dir=runs/mine             # after recipes/collect.py
    python recipes/baselines.py run_dir=runs/mine "baselines.algorithms=[bc,bcq_one_hot]"

TorchRL's BC, TD3+BC, IQL and CQL, one policy per task, and one BCQ for all tasks whose observation
holds the task's one-hot index, without stage 2. Every policy plays the evaluation's episodes.
Started again on the same run folder it goes on where it stopped.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from pathlib import Path

import hydra
from evaluate import keep_rows, play
from learners import ALL_TASKS, ONE_HOT, Learner, one_hot_task
from omegaconf import DictConfig
from settings import BASELINES, Config, run_recipe
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.envs.transforms import Compose

from torchrl_bmrl.data import make_multi_task_replay_buffer
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.errors import StoppedError
from torchrl_bmrl.evaluation import (
    POLICIES,
    ResultRow,
    bootstrap_interval,
    read_results,
    summarise,
    write_results,
)
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.names import TASKS, horizon_of
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import MISSING, Table, policy_name, task_name
from torchrl_bmrl.run.folder import close_logger, log_metrics, make_logger, open_run
from torchrl_bmrl.run.workers import Report, run_jobs
from torchrl_bmrl.training import keep_freed_memory
from torchrl_bmrl.training.health import check_metrics

Job = tuple[Config, str, str]
"""Settings, algorithm, and task or :data:`ALL_TASKS`."""


def number_of_updates(config: Config) -> int:
    """Of each algorithm."""
    as_stage_1 = config.bcq.epochs * config.bcq.updates_per_epoch
    return as_stage_1 if config.baselines.updates is None else config.baselines.updates


def make_buffer(config: Config, algorithm: str, task: str) -> ReplayBuffer:
    """The demonstrations that an algorithm learns from: a row per task."""
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    datasets = []
    for i, name in enumerate(config.tasks):
        if task in (name, ALL_TASKS):
            data = load_transitions(data_dir, name, statistics, split="train", num_task=i)
            if algorithm == ONE_HOT:
                transform = Compose(*one_hot_task(i, len(config.tasks)))
                data = transform(data.copy()).set("next", transform(data["next"].copy()))
            datasets.append(data)
    options = {"batch_size": config.bcq.batch_size, "device": config.device}
    return make_multi_task_replay_buffer(datasets, **options)


def train_job(job: Job, report: Report) -> None:
    """Trains an algorithm on its demonstrations, or goes on from its checkpoint."""
    config, algorithm, task = job
    keep_freed_memory()
    learner, total = Learner(config, algorithm, task), number_of_updates(config)
    buffer = make_buffer(config, algorithm, task)
    learner.load()  # after all that draws random numbers
    if learner.updates:
        report(learner.updates)
    if learner.updates == total:
        return
    logger = make_logger(
        config.logger, Path(config.run_dir), f"baselines_{learner.name}", learner.updates
    )
    choose = learner.choose_updates(total)

    def check(metrics: dict[str, Tensor], number: int) -> dict[str, float]:
        row = {key: float(value) for key, value in metrics.items()}
        check_metrics(row, f"{learner.name}, update {number}")
        return row

    number = learner.updates
    try:
        for number in range(learner.updates + 1, total + 1):
            batch = buffer.sample().select(*learner.loss.in_keys).reshape(-1)
            metrics = choose(number)(batch)
            saving = number % config.checkpoint_interval == 0 or number == total
            logging = number % config.log_interval == 0
            if logging or saving:  # the only places that wait for the device
                log_metrics(logger if logging else None, check(metrics, number), number)
            if saving:
                learner.save(number)
            report(1)
    except StoppedError:
        if learner.updates < number:
            check(metrics, number)
            learner.save(number)
        raise
    finally:
        close_logger(logger)


# -- evaluation ------------------------------------------------------------------------------------


def evaluate_job(job: Job, report: Report) -> list[ResultRow]:
    """The evaluation's episodes of a trained algorithm and one task; read back if there."""
    config, algorithm, task = job

    def outcomes(seeds: list[int]) -> list[EpisodeOutcome]:
        learner = Learner(config, algorithm, ALL_TASKS if algorithm == ONE_HOT else task)
        learner.load()
        statistics = read_statistics(Path(config.run_dir) / "data")
        transforms = []
        if algorithm == ONE_HOT:
            transforms = one_hot_task(config.tasks.index(task), len(config.tasks))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            policy = learner.make_policy().to("cpu")
            options = {"statistics": statistics, "seeds": seeds, "report": report}
            return play(config, task, policy, *transforms, **options)

    return keep_rows(config, task, algorithm, outcomes, report=report)


def make_table(rows: list[ResultRow], updates: int) -> Table:
    """One line per policy, one column per task; ``updates`` are those of each baseline."""
    tasks = sorted({row.task for row in rows}, key=TASKS.index)
    found = {(s.policy, s.latent_source, s.task): s for s in summarise(rows)}
    policies = sorted({key[:2] for key in found}, key=lambda key: (POLICIES.index(key[0]), key[1]))
    lines = []
    for policy in policies:
        mine = [row for row in rows if (row.policy, row.latent_source) == policy]
        successes = [float(row.success) for row in mine]
        low, high = bootstrap_interval(successes, strata=[row.task for row in mine])
        each = [found.get((*policy, task)) for task in tasks]
        lines.append(
            (
                policy_name(policy[0]) + (f" ({policy[1]})" if policy[1] else ""),
                *(f"{s.mean_return:.1f}, {s.success_rate:.0%}" if s else MISSING for s in each),
                f"{sum(successes) / len(successes):.0%}",
                f"[{low:.0%}, {high:.0%}]",
                str(len(mine)),
            )
        )
    return Table(
        title="The two stages beside other offline algorithms",
        caption=(
            "Mean return over an episode, and success, on the same starts; the expert's are its "
            "demonstrations unless it was evaluated. BCQ: stage 1, one agent per task. Distilled: "
            "stage 2, with the source of m in brackets. BC, TD3+BC, IQL and CQL: TorchRL's losses, "
            "one policy per task. BCQ, one-hot task: one agent trained on all tasks, whose "
            f"observation holds the task's index; {updates:,} updates each. Interval: bootstrap "
            "over the episodes of each task."
        ),
        header=("Policy", *map(task_name, tasks), "Success, all", "95% interval", "Episodes"),
        rows=lines,
    )


def baselines(config: Config) -> None:
    """Trains and evaluates what is not done yet, then writes ``baselines.csv`` and the table."""
    run_dir, updates = Path(config.run_dir), number_of_updates(config)
    read_statistics(run_dir / "data")  # before anything is written
    # More algorithms may join those that are there; nothing else may differ.
    open_run(run_dir / "baselines", {"updates": updates})
    names = [name for name in BASELINES if name in config.baselines.algorithms]
    trained = [
        (config, name, task)
        for name in names
        for task in ([ALL_TASKS] if name == ONE_HOT else config.tasks)
    ]
    run_jobs(
        train_job,
        trained,
        workers=config.workers,
        total=len(trained) * updates,
        description="training baselines",
        unit="update",
    )
    played = [(config, name, task) for name in names for task in config.tasks]
    parts = run_jobs(
        evaluate_job,
        played,
        workers=config.workers,
        total=sum(config.evaluate.episodes * horizon_of(task) for *_, task in played),
        description="evaluating baselines",
        unit="step",
    )
    rows = [row for part in parts for row in part]
    write_results(run_dir / "baselines.csv", rows)
    results = run_dir / "results.csv"
    stages = read_results(results) if results.exists() else []
    table = make_table(stages + rows, updates)
    write_study(run_dir, "baselines", Section(heading="Baselines", tables=[table]), {})
    print(table.markdown())


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, baselines)


if __name__ == "__main__":
    main()
