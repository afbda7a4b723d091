"""The baselines as they are trained: their losses, what each network minimises, their updates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from algorithms import Algorithm, bc, cql, iql, td3_bc
from bcq_agents import LOSS_SETTINGS
from settings import Config, deciding_settings
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torch.optim import Adam
from torchrl.envs.transforms import CatTensors, Transform
from torchrl.objectives import CQLLoss, LossModule, SoftUpdate
from train_bcq import choose_updates

from torchrl_bmrl.modules import BCQPolicy, PrototypeTaskLatent
from torchrl_bmrl.pipeline.agents import ACTION_DIM, OBSERVATION_DIM, make_bcq_loss
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.training import (
    Update,
    gradient_step,
    make_adam,
)
from torchrl_bmrl.training.checkpoint import keep_training, resume_training

BUILDERS = {build.__name__: build for build in (bc, td3_bc, iql, cql)}
ONE_HOT = "bcq_one_hot"
ALL_TASKS = "all"


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
            return loss, lambda: BCQPolicy.frozen(loss, num_candidates=count)
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
            optimizers = {key.removesuffix("_network"): x for key, x in self.optimizers.items()}
            return choose_updates(self.config, self.loss, optimizers, self.targets)
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

    def load(self) -> None:
        """Goes on from what was kept, if anything was."""
        kept = resume_training(
            self.path, self.loss, self.optimizers, kind="baseline", device=self.config.device
        )
        self.updates = kept["updates"] if kept else 0

    def save(self, updates: int) -> None:
        """Keeps what the training goes on from."""
        self.updates = updates
        metadata = {"kind": "baseline", "name": self.name, "updates": updates}
        metadata |= {"settings": deciding_settings(self.config)}
        options = {"device": self.config.device, "keep": self.config.keep_checkpoints}
        keep_training(self.path, self.loss, self.optimizers, metadata, **options)
