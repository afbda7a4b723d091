"""Other offline algorithms on a run's demonstrations, played from the evaluation's starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

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
from torchrl_bmrl.data.n_step import STEPS_KEY
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.modules import BCQPolicy, PrototypeTaskLatent
from torchrl_bmrl.pipeline.agents import load_bcq_loss, make_bcq_loss
from torchrl_bmrl.pipeline.evaluate import evaluate_job as evaluate_stages
from torchrl_bmrl.pipeline.evaluate import evaluate_once
from torchrl_bmrl.pipeline.learners import loss_options, make_step, sizes_of
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.stage1 import make_policy
from torchrl_bmrl.pipeline.task_files import check_playable
from torchrl_bmrl.pipeline.training_data import training_data as stage_1_data
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.run.folder import open_run, other_setting
from torchrl_bmrl.run.loggers import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.studies.algorithms import (
    ALGORITHMS,
    OBJECTIVES,
    check_coefficients,
    make_loss,
    objectives,
    published,
    training_data,
)
from torchrl_bmrl.studies.baselines_report import make_paired_table, make_table
from torchrl_bmrl.training.checkpoint import load_newest, resume_training, save_training
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.health import check_metrics, largest_metric
from torchrl_bmrl.training.update import decay, gradient_step, keep_freed_memory, make_adam

ONE_HOT = "bcq_one_hot"
"""One BCQ agent for all tasks, whose observation contains the task's one-hot index."""
ALL_TASKS = "all"
BASELINES = (*ALGORITHMS, ONE_HOT)
STARTS = ("evaluation", "development")
Coefficients = Mapping[str, float]
"""Coefficients of one algorithm that differ from the published ones, by name."""


@dataclass
class BaselineSettings:
    """Settings of :func:`baselines`."""

    algorithms: list[str] = setting(list(BASELINES), choices=BASELINES, unique=True)
    updates: int | None = setting(None, above=0)  # of each; null: as many as a stage-1 agent
    # By algorithm and name; those that are not given are the published ones.
    coefficients: dict[str, dict[str, Any]] = field(default_factory=dict)
    starts: str = setting("evaluation", choices=STARTS)  # development: other seeds, for tuning
    folder: ClassVar[str] = "baselines"  # of the study, below the run's


def baselines(run: Run, settings: BaselineSettings) -> str:
    """Trains and evaluates the algorithms, then writes ``baselines.csv`` and two tables.

    Every algorithm has one policy per task, except :data:`ONE_HOT`. Finished parts are read back.
    With development starts it writes ``baselines_dev.csv`` and the tables of these episodes, which
    the page does not show. Then the run's agents of stage 1, if they are trained, play too.

    Args:
        run: an open run with demonstrations; if it has ``results.csv``, the tables contain these
            policies too.
        settings: which algorithms, their coefficients and number of updates, and the starts.

    Returns:
        the tables as Markdown.

    Raises:
        BMRLError: if demonstrations are missing, a task has no environment, a coefficient is
            unknown or another one than that of the finished training, or a training diverges.
    """
    run.check_open()
    check_playable(run.tasks)
    check_coefficients(settings.coefficients, "baselines.coefficients")
    run.statistics  # noqa: B018 (missing demonstrations are found before anything is written)
    total = settings.updates or run.settings.bcq.updates
    names = [name for name in BASELINES if name in settings.algorithms]
    if ONE_HOT in names:
        run.settings.bcq.check_single_actions(f"baselines.algorithms with {ONE_HOT}")
    coefficients = {name: dict(settings.coefficients.get(name, {})) for name in names}
    trained = [
        (name, task, total, coefficients[name])
        for name in names
        for task in ([ALL_TASKS] if name == ONE_HOT else run.names)
    ]
    # More algorithms may join the finished ones, with the same number of updates.
    open_run(run.folder / settings.folder, {"updates": total})
    for name, task, _, values in trained:
        check_trained(run, name, task, values)
    run.jobs(
        train_job,
        trained,
        total=len(trained) * total,
        description="training baselines",
        unit="update",
    )
    development = settings.starts == "development"
    also = ["bcq"] if development and has_agents(run) else []
    played = [
        (name, task, coefficients.get(name, {}), development)
        for name in (*also, *names)
        for task in run.names
    ]
    parts = run.jobs(
        evaluate_job,
        played,
        total=sum(run.settings.evaluate.episodes * run.horizon(run.task(t)) for _, t, *_ in played),
        description="evaluating baselines",
        unit="step",
    )
    rows = [row for part in parts for row in part]
    file = "baselines_dev" if development else "baselines"
    write_results(run.folder / f"{file}.csv", rows)
    experts = run.jobs(
        evaluate_stages,
        [(task, "expert", "") for task in run.names],
        total=sum(run.settings.evaluate.episodes * run.horizon(task) for task in run.tasks),
        description="evaluating the expert",
        unit="step",
    )
    shown = [row for part in experts for row in part]
    results = run.folder / "results.csv"
    if results.exists() and not development:
        shown += [row for row in read_results(results) if row.policy != "expert"]
    given = {name: values for name, values in coefficients.items() if values}
    tables = {
        file: make_table(shown + rows, total, run.titles, given),
        f"{file}_paired": make_paired_table(shown + rows, run.titles),
    }
    for name, table in tables.items():
        if development:
            write_atomic(run.folder / "tables" / f"{name}.md", table.markdown())
            write_atomic(run.folder / "tables" / f"{name}.csv", table.csv())
        else:
            heading = "Baselines" if name == file else "Baselines: paired differences"
            write_study(run.folder, name, Section(heading=heading, tables=[table]), {})
    return "\n".join(table.markdown() for table in tables.values())


def has_agents(run: Run) -> bool:
    """Whether the run has a finished stage-1 agent of every task."""
    paths = [run.agent_path(name) for name in run.names]
    return all(path.exists() for path in paths) and all(
        load_bcq_loss(path)[1]["updates"] == run.settings.bcq.updates for path in paths
    )


def check_trained(run: Run, algorithm: str, task: str, coefficients: Coefficients) -> None:
    """Compares an algorithm's coefficients with those of its checkpoint, if there is one.

    Args:
        run: the run.
        algorithm: one of :data:`BASELINES`.
        task: name of its task, or :data:`ALL_TASKS`.
        coefficients: those that differ from the published ones.

    Raises:
        ConfigError: naming the first one that differs.
    """
    saved = load_newest(checkpoint_path(run.folder, algorithm, task), kind="baseline")
    if saved is None:
        return
    now = {**published(algorithm), **coefficients}
    before = {**published(algorithm), **saved[1].get("coefficients", {})}
    for name in sorted(now | before):
        if now.get(name) != before.get(name):
            key = f"coefficients.{algorithm}.{name}"
            raise other_setting(
                run.folder / BaselineSettings.folder, key, now.get(name), before.get(name)
            )


def checkpoint_path(folder: Path, algorithm: str, task: str) -> Path:
    """The checkpoint of a baseline, in a run folder."""
    name = f"{algorithm}-{task}"
    return folder / BaselineSettings.folder / name / "checkpoint.safetensors"


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
        coefficients: those that differ from the published ones.
    """

    def __init__(self, run: Run, algorithm: str, task: str, coefficients: Coefficients) -> None:
        self.run, self.algorithm, self.name = run, algorithm, f"{algorithm}-{task}"
        self.coefficients = dict(coefficients)
        self.path = checkpoint_path(run.folder, algorithm, task)
        sizes, bcq = sizes_of(run.transitions(run.names[0], "train")), run.settings.bcq
        torch.manual_seed(run.seed("baselines", self.name))
        if algorithm == ONE_HOT:
            sizes["observation_dim"] += len(run.names)
            self.loss, self.actor = make_bcq_loss(**(loss_options(bcq) | sizes)), None
            networks = ["generator", "qvalue_network"]
            networks += ["perturbation_network"] if bcq.perturbation else []
        else:
            options: dict[str, Any] = {"gamma": bcq.gamma, "layer_norm": bcq.layer_norm}
            self.loss, self.actor = make_loss(
                algorithm, sizes, bcq.num_cells, self.coefficients, **options
            )
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
        bcq = self.run.settings.bcq
        if self.algorithm == ONE_HOT:
            optimizers = {key.removesuffix("_network"): x for key, x in self.optimizers.items()}
            return make_step(self.run, self.loss, optimizers, self.targets, total)

        # Never compiled: IQL and CQL do not compile in one piece, and for the others compiling
        # takes longer than it saves.
        def step(update: int, batch: TensorDictBase) -> dict[str, Tensor]:
            metrics, chosen = {}, objectives(self.algorithm, update, total)
            if bcq.cosine:
                for optimizer in self.optimizers.values():
                    decay(optimizer, bcq.lr, update, total)
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
        if self.coefficients:
            metadata["coefficients"] = self.coefficients
        save_training(
            self.path,
            self.loss,
            self.optimizers,
            metadata,
            device=settings.device,
            keep=settings.keep_checkpoints,
        )


def make_buffer(run: Run, algorithm: str, task: str, coefficients: Coefficients) -> ReplayBuffer:
    """The demonstrations that an algorithm learns from, with one row of the batch per task."""
    datasets, bcq = [], replace(run.settings.bcq, action_chunk=1)
    for index, name in enumerate(run.names):
        if task not in (name, ALL_TASKS):
            continue
        data = training_data(algorithm, run.transitions(name, "train"), coefficients)
        # After the next actions, which become those after the last of the n steps.
        (data,) = stage_1_data([data], bcq)
        if algorithm == ONE_HOT:
            transform = Compose(*one_hot_task(index, len(run.names)))
            data = transform(data.copy()).set("next", transform(data["next"].copy()))
        if bcq.n_steps > 1:
            data.set(("next", STEPS_KEY), data[STEPS_KEY])  # for IQL, see make_loss
        datasets.append(data)
    return make_multi_task_replay_buffer(
        datasets, batch_size=bcq.batch_size, device=run.settings.device
    )


def train_job(job: tuple[Run, tuple[str, str, int, Coefficients]], report: Report) -> None:
    """Trains an algorithm on its demonstrations, or resumes from its checkpoint."""
    run, (algorithm, task, total, coefficients) = job
    keep_freed_memory()
    settings, learner = run.settings, Learner(run, algorithm, task, coefficients)
    buffer = make_buffer(run, algorithm, task, coefficients)
    largest = largest_metric(buffer[:]["next", "reward"])
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
            check_metrics(metrics, f"{learner.name}, update {update}", largest=largest)
            log_metrics(logger if logging else None, metrics, update)

        keys = [*learner.loss.in_keys, STEPS_KEY, ("next", STEPS_KEY)]
        fit(
            learner.make_step(total),
            lambda: buffer.sample().select(*keys, strict=False).reshape(-1),
            start=learner.updates,
            total=total,
            every=Every(log=settings.log_interval, save=settings.checkpoint_interval),
            check=check,
            save=learner.save,
            report=report,
        )


def evaluate_job(
    job: tuple[Run, tuple[str, str, Coefficients, bool]], report: Report
) -> list[ResultRow]:
    """The episodes of a trained algorithm, or of stage 1's ``bcq``, on one task."""
    run, (algorithm, name, coefficients, development) = job
    task = ALL_TASKS if algorithm == ONE_HOT else name

    def play(seeds: list[int]) -> list[EpisodeOutcome]:
        transforms = []
        if algorithm == "bcq":
            policy: TensorDictModuleBase = make_policy(run.teacher(name), run.settings)
        else:
            learner = Learner(run, algorithm, task, coefficients)
            learner.load()
            policy = learner.make_policy().to("cpu")
        if algorithm == ONE_HOT:
            transforms = one_hot_task(run.names.index(name), len(run.names))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return run.play(run.task(name), policy, *transforms, seeds=seeds, report=report)

    own = checkpoint_path(run.folder, algorithm, task)
    of = [run.agent_path(name) if algorithm == "bcq" else own]
    return evaluate_once(run, name, algorithm, play, of=of, development=development, report=report)
