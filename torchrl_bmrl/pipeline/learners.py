"""Agents of stage 1 in training: one alone, or several as one stacked loss."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Adam
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_bmrl.data.n_step import STEPS_KEY
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import BCQSettings
from torchrl_bmrl.training.checkpoint import (
    load_checkpoint,
    resume_training,
    save_checkpoint,
    save_training,
)
from torchrl_bmrl.training.health import (
    check_metrics,
    check_proposals,
    largest_metric,
    value_limits,
)
from torchrl_bmrl.training.update import Update, accelerate, decay, gradient_step, make_adam

log = logging.getLogger(__name__)

NOT_OF_THE_LOSS = (
    "epochs",
    "updates_per_epoch",
    "eval_episodes",
    "batch_size",
    "lr",
    "cosine",
    "n_steps",
    "action_chunk",
    "standard_reward",
    "tau",
    "generator_warmup",
    "critic_grad_clip",
    "seeds",
    "stacked",
)


def loss_options(settings: BCQSettings) -> dict[str, Any]:
    """Returns the settings that are options of :func:`.make_bcq_loss`."""
    return {name: x for name, x in vars(settings).items() if name not in NOT_OF_THE_LOSS}


def sizes_of(data: TensorDictBase) -> dict[str, int]:
    """Returns the sizes of observation and action, as options of networks."""
    return {f"{key}_dim": data[key].shape[-1] for key in ("observation", "action")}


def make_optimizers(loss: LossModule, settings: BCQSettings) -> dict[str, Adam]:
    """Returns an optimizer for each network of a BCQ loss, in update order."""
    networks = ["generator", "qvalue_network"]
    networks += ["perturbation_network"] if settings.perturbation else []
    return {
        name.removesuffix("_network"): make_adam(
            getattr(loss, f"{name}_params").parameters(), settings.lr
        )
        for name in networks
    }


def make_update(
    loss: LossModule, optimizers: dict[str, Adam], targets: SoftUpdate, max_norm: float | None
) -> Update:
    """Returns an update of each network with an optimizer, in their order, and of the targets."""

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        metrics: dict[str, Tensor] = {}
        for network, optimizer in optimizers.items():
            value, info = getattr(loss, f"{network}_loss")(batch)
            gradient_step(optimizer, value, max_norm if network == "qvalue" else None)
            metrics |= {f"loss_{network}": value.detach()} | info
        targets.step()
        metrics.pop("td_error", None)  # one number per transition
        return metrics

    return update


def make_step(
    run: Run, loss: LossModule, optimizers: dict[str, Adam], targets: SoftUpdate, total: int
) -> Callable[[int, TensorDictBase], dict[str, Tensor]]:
    """Returns a function that does the update of a given number on a batch.

    The first ``generator_warmup`` updates train only the generator. With ``cosine`` the learning
    rate decays until update ``total``.
    """
    settings, bcq = run.settings, run.settings.bcq

    def accelerated(*networks: str) -> Update:
        chosen = {name: optimizers[name] for name in networks}
        return accelerate(
            make_update(loss, chosen, targets, bcq.critic_grad_clip),
            compiled=settings.compile,
            captured=settings.cudagraphs,
            device=settings.device,
        )

    whole = accelerated(*optimizers)
    warm_up = accelerated("generator") if bcq.generator_warmup else whole

    def step(number: int, batch: TensorDictBase) -> dict[str, Tensor]:
        if bcq.cosine:
            for optimizer in optimizers.values():
                decay(optimizer, bcq.lr, number, total)
        return (warm_up if number <= bcq.generator_warmup else whole)(batch)

    return step


class Agents:
    """Agents with their optimizers, saved under ``bcq/<name>``; several are one stacked loss.

    Args:
        run: the run.
        agents: the task of each agent, by the agent's name.
        datasets: the transitions of each agent, ``[N_i]``.
    """

    def __init__(
        self, run: Run, agents: dict[str, str], datasets: Sequence[TensorDictBase]
    ) -> None:
        self.run, self.agents, self.names = run, agents, list(agents)
        settings, self.device = run.settings.bcq, run.settings.device
        self.options = loss_options(settings) | sizes_of(datasets[0])
        rewards = [data["next", "reward"] for data in datasets]
        self.limits = [value_limits(reward, settings.gamma) for reward in rewards]
        self.largest = [largest_metric(reward) for reward in rewards]
        losses = []
        for name in self.names:  # the same initial networks alone and in a stack
            torch.manual_seed(run.seed("bcq", name))
            losses.append(make_bcq_loss(**self.options))
        if len(losses) == 1:
            self.loss, self.kind = losses[0], "bcq"
            self.path = run.agent_path(self.names[0])
        else:
            torch.manual_seed(run.seed("bcq", *self.names))
            self.loss, self.kind = StackedLoss(losses, self.names), "bcq stack"
            self.path = run.folder / "bcq" / "stacked.safetensors"
        self.loss.to(self.device)
        self.optimizers = make_optimizers(self.loss, settings)
        self.targets = SoftUpdate(self.loss, tau=settings.tau)  # copies the critics
        self.updates = 0
        self.evaluations: dict[str, list[dict]] = {name: [] for name in self.names}
        self.diverged: dict[str, str] = {}  # error message by agent

    def agent(self, name: str) -> BCQLoss:
        """Returns an agent's current loss."""
        stacked = isinstance(self.loss, StackedLoss)
        return self.loss.member(self.names.index(name)) if stacked else self.loss

    def make_step(self, total: int) -> Callable[[int, TensorDictBase], dict[str, Tensor]]:
        """Returns :func:`make_step` of these agents."""
        return make_step(self.run, self.loss, self.optimizers, self.targets, total)

    def sample(self, buffer: ReplayBuffer) -> TensorDictBase:
        """Returns a batch of a buffer with what the agents read."""
        return buffer.sample().select(*self.loss.in_keys, STEPS_KEY, strict=False)

    @property
    def healthy(self) -> list[str]:
        """Agents that have not diverged."""
        return [name for name in self.names if name not in self.diverged]

    def check(
        self, metrics: dict[str, Tensor], batch: TensorDictBase, update: int
    ) -> dict[str, dict[str, float]]:
        """Returns the metrics of every agent that has not diverged.

        An agent that has diverged is no longer saved.

        Raises:
            BMRLError: if all agents have diverged.
        """
        columns = {key: torch.atleast_1d(value).tolist() for key, value in metrics.items()}
        rows = {}
        for name in self.healthy:
            i = self.names.index(name)
            rows[name] = {key: column[i] for key, column in columns.items()}
            mine = batch if self.kind == "bcq" else batch[i]
            where = f"bcq {name}, update {update}"
            try:
                check_metrics(rows[name], where, self.limits[i], largest=self.largest[i])
                check_proposals(self.proposals(name, mine), mine["action"], where)
            except BMRLError as error:
                self.diverged[name] = str(error)
                if not self.healthy:
                    raise
                log.warning(f"{error}; training continues without it")
                del rows[name]
        return rows

    @torch.no_grad()
    def proposals(self, name: str, batch: TensorDictBase) -> Tensor:
        """Returns candidates of an agent, ``(states, candidates, action_dim)``."""
        loss = self.agent(name)
        states = batch[:32].select(*loss.observation_keys)
        device = torch.device(self.device)
        # Training draws the same random numbers with and without this check.
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            return loss.propose(states, 10)["action"]

    def load(self) -> None:
        """Loads the last checkpoint, if there is one."""
        saved = resume_training(
            self.path, self.loss, self.optimizers, kind=self.kind, device=self.device
        )
        if saved is None:
            return
        self.updates = saved["updates"]
        if self.kind == "bcq":
            self.evaluations = {self.names[0]: saved["evaluations"]}
            return
        self.evaluations, self.diverged = saved["evaluations"], saved["diverged"]
        for name in self.healthy:
            path = self.run.agent_path(name)
            if not path.exists() or load_checkpoint(path, kind="bcq")[1]["updates"] != self.updates:
                self.save_agent(name)  # the process was killed between the two files

    def save(self, update: int) -> None:
        """Saves the state of the training, and every agent that has not diverged."""
        self.updates = update
        if self.kind == "bcq":
            metadata = self.metadata(self.names[0])
        else:
            metadata = {"kind": self.kind, "names": self.names, "updates": update}
            metadata |= {"evaluations": self.evaluations, "diverged": self.diverged}
            metadata["settings"] = self.run.settings.deciding()
        save_training(
            self.path,
            self.loss,
            self.optimizers,
            metadata,
            device=self.device,
            keep=self.run.settings.keep_checkpoints,
        )
        if self.kind != "bcq":
            for name in self.healthy:
                self.save_agent(name)

    def save_agent(self, name: str) -> None:
        """Saves a member of a stack as an agent's checkpoint."""
        state = {"module": self.agent(name).state_dict()}
        save_checkpoint(self.run.agent_path(name), state, self.metadata(name))

    def save_best(self, name: str, update: int) -> None:
        """Saves an agent's networks if its last epoch has the highest mean return so far."""
        returns: dict[int, list[float]] = {}
        for row in self.evaluations[name]:
            returns.setdefault(row["epoch"], []).append(row["return"])
        means = [fmean(values) for values in returns.values()]
        if means[-1] == max(means):
            state = {"module": self.agent(name).state_dict()}
            metadata = self.metadata(name) | {"updates": update}
            save_checkpoint(
                self.run.agent_path(name).with_name("best.safetensors"), state, metadata
            )

    def metadata(self, name: str) -> dict[str, Any]:
        """The description in an agent's checkpoint."""
        return {
            "kind": "bcq",
            "task": self.agents[name],
            "loss": self.options,
            "updates": self.updates,
            "evaluations": self.evaluations[name],
            "settings": self.run.settings.deciding(),
            "statistics": self.run.statistics.to_lists(),
        }
