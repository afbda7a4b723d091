"""Baselines on the same demonstrations: what do the two stages buy?

    python recipes/baselines.py run_dir=runs/mine             # after recipes/collect.py
    python recipes/baselines.py run_dir=runs/mine "baselines.algorithms=[bc,bcq_one_hot]"

TorchRL's BC, TD3+BC, IQL and CQL, one policy per task, and one BCQ for all tasks whose observation
holds the task's one-hot index, without stage 2. Every policy plays the evaluation's episodes.
Started again on the same run folder it goes on where it stopped.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from algorithms import Algorithm, bc, cql, iql, td3_bc
from bcq_agents import LOSS_SETTINGS
from evaluate import keep_rows, play
from omegaconf import DictConfig
from settings import BASELINES, Config, run_recipe
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torch.optim import Adam
from torchrl.data import ReplayBuffer
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.envs.transforms import CatTensors, Compose, Transform
from torchrl.objectives import CQLLoss, LossModule, SoftUpdate
from train_bcq import make_update as make_bcq_update

from torchrl_bmrl.agents import ACTION_DIM, OBSERVATION_DIM, make_bcq_loss
from torchrl_bmrl.checkpoint import load_checkpoint, load_state, save_checkpoint
from torchrl_bmrl.data import make_multi_task_replay_buffer
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.evaluation import (
    POLICIES,
    ResultRow,
    bootstrap_interval,
    read_results,
    summarise,
    write_results,
)
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.modules import BCQPolicy, PrototypeTaskLatent
from torchrl_bmrl.names import HORIZON, TASKS
from torchrl_bmrl.parallel import Report, derive_seed, run_jobs
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import MISSING, Table, policy_name, task_name
from torchrl_bmrl.runs import check_finite, log_metrics, make_logger, open_run
from torchrl_bmrl.training import (
    Update,
    accelerate,
    get_rng_state,
    gradient_step,
    keep_freed_memory,
    load_adam,
    make_adam,
    set_rng_state,
)

BUILDERS = {build.__name__: build for build in (bc, td3_bc, iql, cql)}
ONE_HOT = "bcq_one_hot"
ALL_TASKS = "all"
Job = tuple[Config, str, str]
"""Settings, algorithm, and task or :data:`ALL_TASKS`."""


def one_hot_task(index: int, num_tasks: int) -> list[Transform]:
    """Appends a task's one-hot index to the observation, of data and in environments alike."""
    point = one_hot(torch.tensor(index), num_tasks).float()
    keys = ["observation", "task_latent"]  # the index stands where m does after stage 2
    return [PrototypeTaskLatent(point), CatTensors(keys, "observation", sort=False)]


# -- updates, as they were published ---------------------------------------------------------------

Objective = Callable[[Any, TensorDictBase], Tensor]
"""From a loss and a batch to what one optimizer minimises."""


def method(name: str) -> Objective:
    """A method of the loss."""
    return lambda loss, batch: getattr(loss, name)(batch)[0]


def bc_actor(loss: LossModule, batch: TensorDictBase) -> Tensor:
    """Imitation; the loss has this term alone."""
    return loss(batch)["loss_bc"]


def cql_critics(loss: CQLLoss, batch: TensorDictBase) -> Tensor:
    """Critics' error and penalty."""
    error = loss.q_loss(batch)[0]  # writes what the penalty reads
    return error + loss.cql_loss(batch)[0]


def cql_actor(loss: CQLLoss, batch: TensorDictBase, *, imitates: bool = False) -> Tensor:
    """Actor's loss, and that of the temperature, which reaches no network."""
    value, info = loss.actor_loss(batch)
    if imitates:
        value = loss.actor_bc_loss(batch)[0]
    return value + loss.alpha_loss(info, mask_tensordict=batch)[0]


OBJECTIVES: dict[str, dict[str, Objective]] = {
    "bc": {"actor_network": bc_actor},
    "td3_bc": {"qvalue_network": method("qvalue_loss"), "actor_network": method("actor_loss")},
    "iql": {
        "value_network": method("value_loss"),
        "actor_network": method("actor_loss"),
        "qvalue_network": method("qvalue_loss"),
    },
    "cql": {"qvalue_network": cql_critics, "actor_network": cql_actor},
}
"""By algorithm, what each network minimises, in update order."""
ACTOR_INTERVAL = 2  # of TD3+BC: updates of the critics to one of actor and targets
IMITATION = 0.04  # of CQL: first share of the updates, in which the actor imitates


def make_update(
    loss: LossModule,
    optimizers: Mapping[str, Adam],
    objectives: Mapping[str, Objective],
    targets: SoftUpdate | None,
) -> Update:
    """One step of every optimizer whose network has an objective, in their order, then targets."""

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        metrics = {}
        for network, objective in objectives.items():
            value = objective(loss, batch)
            gradient_step(optimizers[network], value)
            metrics[f"loss_{network.removesuffix('_network')}"] = value.detach()
        if targets is not None:
            targets.step()
        return metrics

    return update


# -- training --------------------------------------------------------------------------------------


class Learner:
    """An algorithm's loss with its optimizers and targets, kept under ``baselines/``.

    Args:
        config: the settings.
        algorithm: one of :data:`settings.BASELINES`.
        task: its task, or :data:`ALL_TASKS`.
    """

    def __init__(self, config: Config, algorithm: str, task: str) -> None:
        self.config, self.algorithm, self.name = config, algorithm, f"{algorithm}-{task}"
        folder = Path(config.run_dir) / "baselines" / self.name
        self.path = folder / "checkpoint.safetensors"
        torch.manual_seed(derive_seed(config.seed, "baselines", self.name))
        self.loss, self.make_policy = self.build()
        self.loss.to(config.device)
        if algorithm == ONE_HOT:
            networks = ["generator", "qvalue_network"]
            networks += ["perturbation_network"] if config.bcq.perturbation else []
        else:
            networks = list(OBJECTIVES[algorithm])
        self.optimizers = {
            name: make_adam(self.parameters(name), config.bcq.lr) for name in networks
        }
        has_targets = any(key.startswith("target_") for key in self.loss.state_dict())
        self.targets = SoftUpdate(self.loss, tau=config.bcq.tau) if has_targets else None
        self.updates = 0

    def build(self) -> Algorithm:
        """The loss, and what makes its policy."""
        settings = self.config.bcq
        if self.algorithm == ONE_HOT:
            options = {option: getattr(settings, option) for option in LOSS_SETTINGS}
            size = OBSERVATION_DIM + len(self.config.tasks)
            loss = make_bcq_loss(observation_dim=size, **options)
            count = self.config.evaluate.num_candidates
            return loss, lambda: BCQPolicy.from_loss(loss, num_candidates=count)
        build = BUILDERS[self.algorithm]
        loss, make_policy = build(OBSERVATION_DIM, ACTION_DIM, cells=settings.num_cells)
        if self.algorithm != "bc":
            loss.make_value_estimator(gamma=settings.gamma)
        return loss, make_policy

    def parameters(self, network: str) -> list[Tensor]:
        """What an optimizer moves; the one of CQL's actor also its temperature."""
        params = list(getattr(self.loss, f"{network}_params").parameters())
        is_cql_actor = isinstance(self.loss, CQLLoss) and network == "actor_network"
        return [*params, self.loss.log_alpha] if is_cql_actor else params

    def choose_updates(self, total: int) -> Callable[[int], Update]:
        """From an update's number, the first being 1, to what it does."""
        if self.algorithm == ONE_HOT:
            return self.choose_bcq_updates()
        # Never compiled: IQL and CQL do not compile in one piece, and for the others compiling
        # takes longer than it saves.
        objectives = OBJECTIVES[self.algorithm]
        make = partial(make_update, self.loss, self.optimizers)
        whole = make(objectives, self.targets)
        if self.algorithm == "td3_bc":
            critics = make({"qvalue_network": objectives["qvalue_network"]}, None)
            return lambda number: critics if number % ACTOR_INTERVAL else whole
        if self.algorithm == "cql":
            imitates = {"actor_network": partial(cql_actor, imitates=True)}
            imitation = make(objectives | imitates, self.targets)
            return lambda number: imitation if number <= IMITATION * total else whole
        return lambda number: whole

    def choose_bcq_updates(self) -> Callable[[int], Update]:
        """Those of an agent of stage 1."""
        config, warmup = self.config, self.config.bcq.generator_warmup
        optimizers = {key.removesuffix("_network"): x for key, x in self.optimizers.items()}

        def accelerated(*networks: str) -> Update:
            chosen = {name: optimizers[name] for name in networks}
            update = make_bcq_update(self.loss, chosen, self.targets, config.bcq.critic_grad_clip)
            options = {"compiled": config.compile, "captured": config.cudagraphs}
            return accelerate(update, **options, device=config.device)

        whole = accelerated(*optimizers)
        warm_up = accelerated("generator") if warmup else whole
        return lambda number: warm_up if number <= warmup else whole

    def load(self) -> None:
        """Goes on from what was kept, if anything was."""
        if not self.path.exists():
            return
        state, metadata = load_checkpoint(self.path, kind="baseline")
        load_state(self.loss, state["loss"], self.path)
        for name, optimizer in self.optimizers.items():
            load_adam(optimizer, state["optimizers"][name])
        set_rng_state(state["rng"], self.config.device)
        self.updates = metadata["updates"]

    def save(self, updates: int) -> None:
        """Keeps what the training goes on from."""
        state = {
            "loss": self.loss.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.items()},
            "rng": get_rng_state(self.config.device),
        }
        metadata = {"kind": "baseline", "name": self.name, "updates": updates}
        save_checkpoint(self.path, state, metadata)


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
    logger = make_logger(config.logger, Path(config.run_dir), f"baselines_{learner.name}")
    choose = learner.choose_updates(total)
    for number in range(learner.updates + 1, total + 1):
        batch = buffer.sample().select(*learner.loss.in_keys).reshape(-1)
        metrics = choose(number)(batch)
        report(1)
        saving = number % config.checkpoint_interval == 0 or number == total
        logging = number % config.log_interval == 0
        if logging or saving:  # the only places that wait for the device
            row = {key: float(value) for key, value in metrics.items()}
            check_finite(row, f"{learner.name}, update {number}")
            log_metrics(logger if logging else None, row, number)
        if saving:
            learner.save(number)


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
        total=len(played) * config.evaluate.episodes * HORIZON,
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
