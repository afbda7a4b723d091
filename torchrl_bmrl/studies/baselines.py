"""Other offline algorithms on a run's demonstrations, played from the evaluation's starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import ReplayBuffer
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.envs.transforms import CatTensors, Compose, Transform
from torchrl.objectives import CQLLoss, SoftUpdate

from torchrl_bmrl.data import make_multi_task_replay_buffer
from torchrl_bmrl.evaluation import (
    ResultRow,
    bootstrap_interval,
    read_results,
    summarise,
    write_results,
)
from torchrl_bmrl.evaluation.results import policy_order
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.modules import BCQPolicy, PrototypeTaskLatent
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.pipeline.evaluate import evaluate_once
from torchrl_bmrl.pipeline.learners import choose_updates, loss_options
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.stage1 import sizes_of
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import MISSING, Table, policy_name, task_titles
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.loggers import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.studies.algorithms import ALGORITHMS, OBJECTIVES, objectives
from torchrl_bmrl.training.checkpoint import resume_training, save_training
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.health import check_metrics
from torchrl_bmrl.training.update import gradient_step, keep_freed_memory, make_adam

ONE_HOT = "bcq_one_hot"
"""One BCQ agent for all tasks, whose observation contains the task's one-hot index."""
ALL_TASKS = "all"
BASELINES = (*ALGORITHMS, ONE_HOT)


@dataclass
class BaselineSettings:
    """Settings of :func:`baselines`."""

    algorithms: list[str] = setting(list(BASELINES), choices=BASELINES, unique=True)
    updates: int | None = setting(None, above=0)  # of each; null: as many as a stage-1 agent
    folder: ClassVar[str] = "baselines"  # of the study, below the run's


def baselines(run: Run, settings: BaselineSettings) -> str:
    """Trains and evaluates the algorithms, then writes ``baselines.csv`` and a table.

    Every algorithm has one policy per task, except :data:`ONE_HOT`. Finished parts are read back.

    Args:
        run: an open run with demonstrations; if it has ``results.csv``, the table contains these
            policies too.
        settings: which algorithms, and their number of updates.

    Returns:
        the table as Markdown.

    Raises:
        BMRLError: if demonstrations are missing, a task has no environment, or a training diverges.
    """
    run.check_open()
    run.check_playable()
    run.statistics  # noqa: B018 (missing demonstrations are found before anything is written)
    stage_1 = run.settings.bcq.epochs * run.settings.bcq.updates_per_epoch
    updates = settings.updates or stage_1
    # More algorithms may join the finished ones, with the same number of updates.
    open_run(run.folder / settings.folder, {"updates": updates})
    names = [name for name in BASELINES if name in settings.algorithms]
    trained = [
        (name, task, updates)
        for name in names
        for task in ([ALL_TASKS] if name == ONE_HOT else run.names)
    ]
    run.jobs(
        train_job,
        trained,
        total=len(trained) * updates,
        description="training baselines",
        unit="update",
    )
    played = [(name, task) for name in names for task in run.names]
    parts = run.jobs(
        evaluate_job,
        played,
        total=sum(run.settings.evaluate.episodes * run.horizon(run.task(t)) for _, t in played),
        description="evaluating baselines",
        unit="step",
    )
    rows = [row for part in parts for row in part]
    write_results(run.folder / "baselines.csv", rows)
    results = run.folder / "results.csv"
    table = make_table(
        (read_results(results) if results.exists() else []) + rows, updates, run.titles
    )
    write_study(run.folder, "baselines", Section(heading="Baselines", tables=[table]), {})
    return table.markdown()


def one_hot_task(index: int, num_tasks: int) -> list[Transform]:
    """Appends a task's one-hot index to the observation, of data and in environments alike."""
    point = one_hot(torch.tensor(index), num_tasks).float()
    keys = ["observation", "task_latent"]
    return [PrototypeTaskLatent(point), CatTensors(keys, "observation", sort=False)]


class Learner:
    """A baseline with its optimizers and targets, saved under ``baselines/``.

    Args:
        run: the run.
        algorithm: one of :data:`BASELINES`.
        task: name of its task, or :data:`ALL_TASKS`.
    """

    def __init__(self, run: Run, algorithm: str, task: str) -> None:
        self.run, self.algorithm, self.name = run, algorithm, f"{algorithm}-{task}"
        self.path = run.folder / BaselineSettings.folder / self.name / "checkpoint.safetensors"
        sizes, bcq = sizes_of(run.transitions(run.names[0], "train")), run.settings.bcq
        torch.manual_seed(run.seed("baselines", self.name))
        if algorithm == ONE_HOT:
            sizes["observation_dim"] += len(run.names)
            self.loss, self.actor = make_bcq_loss(**(loss_options(bcq) | sizes)), None
            networks = ["generator", "qvalue_network"]
            networks += ["perturbation_network"] if bcq.perturbation else []
        else:
            self.loss, self.actor = ALGORITHMS[algorithm](**sizes, cells=bcq.num_cells)
            if algorithm != "bc":
                self.loss.make_value_estimator(gamma=bcq.gamma)
            networks = list(OBJECTIVES[algorithm])
        self.loss.to(run.settings.device)
        self.optimizers = {name: make_adam(self._parameters(name), bcq.lr) for name in networks}
        has_targets = any(key.startswith("target_") for key in self.loss.state_dict())
        self.targets = SoftUpdate(self.loss, tau=bcq.tau) if has_targets else None
        self.updates = 0

    def _parameters(self, network: str) -> list[Tensor]:
        """Parameters of one optimizer; that of CQL's actor also trains the temperature."""
        params = list(getattr(self.loss, f"{network}_params").parameters())
        is_cql_actor = isinstance(self.loss, CQLLoss) and network == "actor_network"
        return [*params, self.loss.log_alpha] if is_cql_actor else params

    def make_policy(self) -> TensorDictModuleBase:
        """The policy that was trained."""
        if self.actor is not None:
            return self.actor
        return BCQPolicy.frozen(self.loss, num_candidates=self.run.settings.evaluate.num_candidates)

    def make_step(self, total: int) -> Callable[[int, TensorDictBase], dict[str, Tensor]]:
        """A function of an update's number and a batch that trains every network.

        Args:
            total: number of updates.
        """
        if self.algorithm == ONE_HOT:
            optimizers = {key.removesuffix("_network"): x for key, x in self.optimizers.items()}
            choose = choose_updates(self.run, self.loss, optimizers, self.targets)
            return lambda update, batch: choose(update)(batch)

        # Never compiled: IQL and CQL do not compile in one piece, and for the others compiling
        # takes longer than it saves.
        def step(update: int, batch: TensorDictBase) -> dict[str, Tensor]:
            metrics, chosen = {}, objectives(self.algorithm, update, total)
            for network, objective in chosen.items():
                value = objective(self.loss, batch)
                gradient_step(self.optimizers[network], value)
                metrics[f"loss_{network.removesuffix('_network')}"] = value.detach()
            if self.targets is not None and "actor_network" in chosen:
                self.targets.step()
            return metrics

        return step

    def load(self) -> None:
        """Loads the last checkpoint, if there is one."""
        saved = resume_training(
            self.path,
            self.loss,
            self.optimizers,
            kind="baseline",
            device=self.run.settings.device,
        )
        self.updates = saved["updates"] if saved else 0

    def save(self, update: int) -> None:
        """Saves what training resumes from."""
        settings = self.run.settings
        metadata = {"kind": "baseline", "name": self.name, "updates": update}
        metadata |= {"settings": settings.deciding()}
        save_training(
            self.path,
            self.loss,
            self.optimizers,
            metadata,
            device=settings.device,
            keep=settings.keep_checkpoints,
        )


def make_buffer(run: Run, algorithm: str, task: str) -> ReplayBuffer:
    """The demonstrations that an algorithm learns from, with one row of the batch per task."""
    datasets = []
    for index, name in enumerate(run.names):
        if task in (name, ALL_TASKS):
            data = run.transitions(name, "train")
            if algorithm == ONE_HOT:
                transform = Compose(*one_hot_task(index, len(run.names)))
                data = transform(data.copy()).set("next", transform(data["next"].copy()))
            datasets.append(data)
    settings = run.settings
    return make_multi_task_replay_buffer(
        datasets, batch_size=settings.bcq.batch_size, device=settings.device
    )


def train_job(job: tuple[Run, tuple[str, str, int]], report: Report) -> None:
    """Trains an algorithm on its demonstrations, or resumes from its checkpoint."""
    run, (algorithm, task, total) = job
    keep_freed_memory()
    settings, learner = run.settings, Learner(run, algorithm, task)
    buffer = make_buffer(run, algorithm, task)
    learner.load()  # last, since everything above draws random numbers
    if learner.updates:
        report(learner.updates)
    if learner.updates == total:
        return
    with ExitStack() as stack:
        logger = make_logger(
            settings.logger, run.folder, f"baselines_{learner.name}", learner.updates
        )
        stack.callback(close_logger, logger)

        def check(
            update: int, metrics: dict[str, Tensor], batch: TensorDictBase, logging: bool
        ) -> None:
            check_metrics(metrics, f"{learner.name}, update {update}")
            log_metrics(logger if logging else None, metrics, update)

        fit(
            learner.make_step(total),
            lambda: buffer.sample().select(*learner.loss.in_keys).reshape(-1),
            start=learner.updates,
            total=total,
            every=Every(log=settings.log_interval, save=settings.checkpoint_interval),
            check=check,
            save=learner.save,
            report=report,
        )


def evaluate_job(job: tuple[Run, tuple[str, str]], report: Report) -> list[ResultRow]:
    """The evaluation's episodes of a trained algorithm on one task."""
    run, (algorithm, name) = job

    def play(seeds: list[int]) -> list[EpisodeOutcome]:
        learner = Learner(run, algorithm, ALL_TASKS if algorithm == ONE_HOT else name)
        learner.load()
        transforms = []
        if algorithm == ONE_HOT:
            transforms = one_hot_task(run.names.index(name), len(run.names))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            policy = learner.make_policy().to("cpu")
            return run.play(run.task(name), policy, *transforms, seeds=seeds, report=report)

    return evaluate_once(run, name, algorithm, play, report=report)


def make_table(rows: Sequence[ResultRow], updates: int, titles: Mapping[str, str]) -> Table:
    """One line per policy and one column per task.

    Args:
        rows: episodes.
        updates: of each baseline.
        titles: of the tasks by name, in the order of the columns.
    """
    found = {(s.policy, s.latent_source, s.task): s for s in summarise(rows)}
    present = {row.task for row in rows}
    columns = {k: x for k, x in task_titles(present, titles).items() if k in present}
    lines = []
    for policy, source in sorted({key[:2] for key in found}, key=lambda k: (policy_order(k[0]), k)):
        mine = [row for row in rows if (row.policy, row.latent_source) == (policy, source)]
        line = [policy_name(policy) + (f" ({source})" if source else "")]
        for task in columns:
            cell = MISSING
            if (each := found.get((policy, source, task))) is not None:
                cell = f"{each.mean_return:.1f}"
                cell += "" if each.success_rate is None else f", {each.success_rate:.0%}"
            line.append(cell)
        successes = [float(row.success) for row in mine if row.success is not None]
        if len(successes) == len(mine):
            low, high = bootstrap_interval(successes, strata=[row.task for row in mine])
            line += [f"{sum(successes) / len(mine):.0%}", f"[{low:.0%}, {high:.0%}]"]
        else:
            line += [MISSING, MISSING]
        lines.append((*line, str(len(mine))))
    return Table(
        title="The two stages beside other offline algorithms",
        caption=(
            "Mean return over an episode, and success, on the same starts; the expert's are its "
            "demonstrations unless it was evaluated. BCQ: stage 1, one agent per task. Distilled: "
            "stage 2, with the source of m in brackets. BC, TD3+BC, IQL and CQL: TorchRL's losses, "
            "one policy per task. BCQ, one-hot task: one agent trained on all tasks, whose "
            f"observation contains the task's index; {updates:,} updates each. Interval: bootstrap "
            "over the episodes of each task."
        ),
        header=("Policy", *columns.values(), "Success, all", "95% interval", "Episodes"),
        rows=lines,
    )
