"""Published methods on the same data: FOCAL and MBML, trained for the study of held-out members.

FOCAL has no agents: its actor learns from the transitions of all trained members. MBML distils the
run's own agents. ``docs/families.md`` says where both deviate from their publications.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.data import make_multi_task_replay_buffer
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.modules import (
    BCQPolicy,
    embed_context,
    extract_network,
    make_context_encoder,
    make_gaussian_actor,
    make_qvalue_network,
    make_reward_models,
)
from torchrl_bmrl.objectives import FOCALLoss, MBMLLoss
from torchrl_bmrl.pipeline.learners import sizes_of
from torchrl_bmrl.pipeline.rewards import train_reward_models
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.stage2 import value_statistics
from torchrl_bmrl.pipeline.student import Student
from torchrl_bmrl.pipeline.training import Training, make_update
from torchrl_bmrl.pipeline.training_data import deviation
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.training.checkpoint import load_checkpoint
from torchrl_bmrl.training.networks import build
from torchrl_bmrl.training.update import (
    Metrics,
    gradient_step,
    keep_freed_memory,
    make_adam,
)

DATA = ("all", "demonstrations")
"""Data of a peer: all that the run has, or without the episodes of other behaviour."""


@dataclass
class FocalSettings:
    """Training of FOCAL."""

    updates: int = setting(2500, above=0)
    tasks_per_update: int = setting(16, above=1)  # trained members in an update, at random
    batch_size: int = setting(32, above=0)  # transitions of each of them
    context_size: int = setting(16, above=0)  # largest number of transitions of a context
    lr: float = setting(1e-3, above=0)  # that of the divergence's classifier is a third of it
    divergence_weight: float = setting(10.0, at_least=0)  # at the start
    data: str = setting("all", choices=DATA)

    @property
    def total(self) -> int:
        """Number of all updates."""
        return self.updates


@dataclass
class MBMLSettings:
    """Training of MBML."""

    updates: int = setting(3000, above=0)  # of the distillation
    reward_updates: int = setting(1000, above=0)  # of the reward models before it
    batch_size: int = setting(64, above=0)  # transitions of each member per update
    context_size: int = setting(32, above=0)  # largest number of transitions of a context
    lr: float = setting(1e-3, above=0)
    triplet_weight: float = setting(0.1, at_least=0)
    data: str = setting("all", choices=DATA)

    @property
    def total(self) -> int:
        """Number of all updates."""
        return self.reward_updates + self.updates


class Focal(nn.Module):
    """FOCAL's loss with its networks, and m of each trained member.

    Args:
        num_tasks: number of trained members.
        observation_dim: size of the observation.
        action_dim: size of the action.
        num_cells: widths of the hidden layers.
        task_latent_dim: size of m.
        **options: of :class:`.FOCALLoss`.

    Attributes:
        prototypes: m of each trained member's demonstrations, ``(num_tasks, m)``.
    """

    prototypes: Tensor

    def __init__(
        self,
        *,
        num_tasks: int,
        observation_dim: int,
        action_dim: int,
        num_cells: Sequence[int],
        task_latent_dim: int = FOCALLoss.published["task_latent_dim"],
        **options: Any,
    ) -> None:
        super().__init__()
        dims = (observation_dim, action_dim)
        cells: dict[str, Any] = {"num_cells": num_cells}
        reading: dict[str, Any] = {"task_latent_dim": task_latent_dim, **cells}
        self.loss = FOCALLoss(
            make_context_encoder(*dims, task_latent_dim, pooling="mean", **cells),
            make_gaussian_actor(*dims, **reading),
            make_qvalue_network(*dims, **reading),
            make_qvalue_network(*dims, **reading),
            bounds=(-1.0, 1.0),
            gamma=FOCALLoss.published["gamma"],
            **options,
        )
        self.register_buffer("prototypes", torch.zeros(num_tasks, task_latent_dim))

    @property
    def encoder(self) -> TensorDictModule:
        """The encoder of contexts, :func:`.make_context_encoder`'s module."""
        return extract_network(self.loss, "task_encoder")

    def set_prototypes(self, datasets: Sequence[TensorDictBase]) -> None:
        """Computes m of each trained member.

        Args:
            datasets: its demonstrations, ``[N_i]`` each.
        """
        self.prototypes.copy_(torch.stack([embed_context(self.encoder, data) for data in datasets]))

    def policy(self) -> TensorDictModuleBase:
        """The actor without its noise."""
        return extract_network(self.loss, "actor_network").select_out_keys("action")


def load_focal(path: Path) -> Focal:
    """Loads what :func:`train_peer` saved.

    Args:
        path: the checkpoint.

    Raises:
        CheckpointError: if the file is missing, damaged, of another kind or of other shapes.
    """
    state, metadata = load_checkpoint(path, kind="focal")
    return build(Focal, metadata.get("focal"), state, path)


@dataclass(frozen=True)
class PeerJob:
    """A peer to train.

    Attributes:
        name: one of :data:`PEERS`.
        settings: of its training.
        folder: of its checkpoint, below the run's folder.
    """

    name: str
    settings: FocalSettings | MBMLSettings
    folder: str

    def check(self) -> None:
        """Checks the settings.

        Raises:
            ConfigError: for batches of less than two contexts.
        """
        wanted = self.settings
        if wanted.batch_size < 2 * wanted.context_size:
            raise ConfigError(
                f"families.{self.name}.batch_size is {wanted.batch_size}; valid with context_size "
                f"{wanted.context_size}: at least {2 * wanted.context_size}, two contexts"
            )


def train_peer(job: tuple[Run, PeerJob], report: Report) -> None:
    """Trains a peer, or resumes from its checkpoint."""
    run, peer = job
    keep_freed_memory()
    PEERS[peer.name](run, peer, report)


def peer_data(run: Run, source: str) -> list[TensorDictBase]:
    """Transitions of each trained member that a peer learns from, ``[N_i]`` each.

    Args:
        run: the run.
        source: one of :data:`DATA`.
    """
    splits = ("train", "context") if source == "all" and run.has_contexts else ("train",)
    return [torch.cat([run.transitions(name, x) for x in splits]) for name in run.names]


def _train_focal(run: Run, peer: PeerJob, report: Report) -> None:
    focal = peer.settings
    assert isinstance(focal, FocalSettings)
    data = peer_data(run, focal.data)
    own = [run.transitions(name, "train") for name in run.names]
    torch.manual_seed(run.seed("families", peer.name))
    options: dict[str, Any] = {
        "num_tasks": len(data),
        "num_cells": run.settings.distill.num_cells,
        **sizes_of(data[0]),
    }
    module = Focal(
        **options, context_size=focal.context_size, divergence_weight=focal.divergence_weight
    )
    loss = module.loss
    cast(Any, loss.task_encoder).module.set_scales(*data)
    module.to(run.settings.device)
    networks = {
        "encoder": "task_encoder",
        "divergence": "divergence_network",
        "qvalue": "qvalue_network",
        "actor": "actor_network",
    }
    published = FOCALLoss.published
    slower = published["divergence_learning_rate"] / published["learning_rate"]
    rates = {name: focal.lr * (slower if name == "divergence" else 1) for name in networks}
    optimizers = {
        name: make_adam(getattr(loss, f"{network}_params").parameters(), rates[name])
        for name, network in networks.items()
    }
    targets = SoftUpdate(loss, tau=published["tau"])
    buffer = make_multi_task_replay_buffer(
        data, batch_size=focal.batch_size, device=run.settings.device
    )

    def sample() -> TensorDictBase:
        chosen = torch.randperm(len(data))[: focal.tasks_per_update].sort().values
        return buffer.sample()[chosen].select(*loss.in_keys)

    def update(batch: TensorDictBase) -> Metrics:
        metrics: Metrics = {}
        for name, optimizer in optimizers.items():
            for _ in range(published["divergence_updates"] if name == "divergence" else 1):
                value, info = getattr(loss, f"{name}_loss")(batch)
                gradient_step(optimizer, value)
            metrics |= {f"loss_{name}": value.detach()} | info
        loss.adapt_divergence_weight(metrics["divergence"])
        targets.step()
        del metrics["td_error"]  # one number per transition
        return metrics | {"divergence_weight": loss.divergence_weight.clone()}

    def prepare(saved: Focal) -> dict[str, Any]:
        saved.set_prototypes(own)
        return {"focal": options}

    rewards = [each["next", "reward"] for each in data]
    training = Training(run, peer.folder, "focal", module, optimizers, rates, prepare, rewards)
    training.train(update, sample, focal.updates, report)


def _train_mbml(run: Run, peer: PeerJob, report: Report) -> None:
    mbml = peer.settings
    assert isinstance(mbml, MBMLSettings)
    data = peer_data(run, mbml.data)
    own = [run.transitions(name, "train") for name in run.names]
    sizes, device = sizes_of(data[0]), run.settings.device
    torch.manual_seed(run.seed("families", peer.name))
    teachers = [BCQPolicy.frozen(run.teacher(name)) for name in run.names]
    models = make_reward_models(len(data), *sizes.values())
    train_reward_models(
        run,
        f"{peer.folder}/rewards",
        models,
        data,
        report,
        updates=mbml.reward_updates,
        batch_size=mbml.batch_size,
        lr=mbml.lr,
    )

    torch.manual_seed(run.seed("families", peer.name, "distillation"))
    options = {
        "num_tasks": len(data),
        "task_encoder": "set_mean",
        "task_latent_dim": MBMLLoss.published["task_latent_dim"],
        "num_cells": run.settings.distill.num_cells,
        "latent_dim": teachers[0].latent_dim,
        **sizes,
    }
    student = Student(**options)
    student.set_scales(*data)
    loc, scale = value_statistics(teachers, own)
    loss = MBMLLoss(
        student.task_encoder,
        student.generator,
        student.qvalue_network,
        [teacher.generator for teacher in teachers],
        [teacher.qvalue_network for teacher in teachers],
        models,
        latent_dim=teachers[0].latent_dim,
        latent_clip=teachers[0].latent_clip,
        qvalue_loc=loc,
        qvalue_scale=scale,
        reward_scale=torch.stack([deviation(each["next", "reward"]) for each in data]),
        context_size=mbml.context_size,
        triplet_weight=mbml.triplet_weight,
    ).to(device)
    learned = [x for x in loss.parameters() if x.requires_grad]  # the reward models are frozen
    optimizers = {"student": make_adam(learned, lr=mbml.lr)}
    buffer = make_multi_task_replay_buffer(data, batch_size=mbml.batch_size, device=device)

    def prepare(saved: Student) -> dict[str, Any]:
        saved.set_prototypes(own, "mean")
        return {
            "student": options,
            "latent_clip": teachers[0].latent_clip,
            "accuracy": None,
        }

    rates, rewards = {"student": mbml.lr}, [each["next", "reward"] for each in data]
    training = Training(run, peer.folder, "student", student, optimizers, rates, prepare, rewards)
    training.train(
        make_update(loss, optimizers["student"]),
        lambda: buffer.sample().select(*loss.in_keys),
        mbml.updates,
        report,
    )


PEERS: Mapping[str, Callable[[Run, PeerJob, Report], None]] = {
    "focal": _train_focal,
    "mbml": _train_mbml,
}
"""Published methods that are trained for the comparison."""
