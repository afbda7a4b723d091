"""The agents of stage 1 as they are trained: one alone, or several as one stacked loss."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch
from settings import Config, deciding_settings
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.envs.transforms import ObservationStatistics
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.training import make_adam
from torchrl_bmrl.training.checkpoint import (
    keep_training,
    load_checkpoint,
    resume_training,
    save_checkpoint,
)
from torchrl_bmrl.training.health import check_metrics, check_proposals, value_limits

log = logging.getLogger("torchrl_bmrl.recipes")

LOSS_SETTINGS = (
    "num_cells",
    "num_qvalue_nets",
    "perturbation",
    "num_candidates",
    "lmbda",
    "latent_clip",
    "kl_weight",
    "kl_reduction",
    "gamma",
    "max_perturbation",
    "value_bounds",
    "loss_function",
)


class Agents:
    """Agents that are kept under ``bcq/<name>``, several of them as one stacked loss.

    Args:
        config: the settings.
        agents: of each agent its name and its task.
        statistics: of the observations, kept beside the agents.
    """

    def __init__(
        self, config: Config, agents: dict[str, str], statistics: ObservationStatistics
    ) -> None:
        self.config, self.agents, self.statistics = config, agents, statistics
        self.folder, self.names = Path(config.run_dir) / "bcq", list(agents)
        self.options = {option: getattr(config.bcq, option) for option in LOSS_SETTINGS}
        losses = []
        for name in self.names:  # an agent starts the same alone and in a stack
            torch.manual_seed(derive_seed(config.seed, "bcq", name))
            losses.append(make_bcq_loss(**self.options))
        if len(losses) == 1:
            self.loss, self.kind = losses[0], "bcq"
            self.path = self.checkpoint(self.names[0])
        else:
            torch.manual_seed(derive_seed(config.seed, "bcq", *self.names))
            self.loss, self.kind = StackedLoss(losses, self.names), "bcq stack"
            self.path = self.folder / "stacked.safetensors"
        self.loss.to(config.device)
        networks = ["generator", "qvalue_network"]
        networks += ["perturbation_network"] if config.bcq.perturbation else []
        self.optimizers = {  # in update order
            name.removesuffix("_network"): make_adam(
                getattr(self.loss, f"{name}_params").parameters(), config.bcq.lr
            )
            for name in networks
        }
        self.targets = SoftUpdate(self.loss, tau=config.bcq.tau)  # sets them to the critics
        self.updates = 0
        self.evaluations: dict[str, list[dict]] = {name: [] for name in self.names}
        self.diverged: dict[str, str] = {}  # by name, what was not finite

    def checkpoint(self, name: str) -> Path:
        """Where an agent is kept."""
        return self.folder / name / "checkpoint.safetensors"

    def agent(self, name: str) -> BCQLoss:
        """An agent's loss, as it is now."""
        stacked = isinstance(self.loss, StackedLoss)
        return self.loss.member(self.names.index(name)) if stacked else self.loss

    @property
    def well(self) -> list[str]:
        """Agents that have not diverged."""
        return [name for name in self.names if name not in self.diverged]

    def healthy(
        self, metrics: dict[str, Tensor], batch: TensorDictBase, update: int
    ) -> dict[str, dict[str, float]]:
        """Every agent's metrics; one that goes wrong is said and left as it was kept last."""
        columns = {key: torch.atleast_1d(value).tolist() for key, value in metrics.items()}
        rows = {}
        for name in self.well:
            i = self.names.index(name)
            rows[name] = {key: column[i] for key, column in columns.items()}
            mine = batch if self.kind == "bcq" else batch[i]
            where = f"bcq {name}, update {update}"
            try:
                limits = value_limits(mine["next", "reward"], self.config.bcq.gamma)
                check_metrics(rows[name], where, limits)
                check_proposals(self.proposals(name, mine), mine["action"], where)
            except BMRLError as error:
                self.diverged[name] = str(error)
                if not self.well:
                    raise
                log.warning(f"{error}; it is frozen and the others go on")
                del rows[name]
        return rows

    @torch.no_grad()
    def proposals(self, name: str, batch: TensorDictBase) -> Tensor:
        """Some of an agent's candidates, ``(states, candidates, action_dim)``."""
        loss = self.agent(name)
        states = batch[:32].select(*loss.observation_keys)
        device = torch.device(self.config.device)
        # Training draws the same random numbers whether or not it is looked at.
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            return loss.propose(states, 10)["action"]

    def load(self) -> None:
        """Goes on from what was kept, if anything was."""
        device = self.config.device
        kept = resume_training(self.path, self.loss, self.optimizers, kind=self.kind, device=device)
        if kept is None:
            return
        self.updates = kept["updates"]
        if self.kind == "bcq":
            self.evaluations = {self.names[0]: kept["evaluations"]}
        else:
            self.evaluations, self.diverged = kept["evaluations"], kept["diverged"]
            for name in self.well:
                path = self.checkpoint(name)
                if (
                    not path.exists()
                    or load_checkpoint(path, kind="bcq")[1]["updates"] != self.updates
                ):
                    self.save_agent(name)  # a kill came in between

    def save(self, update: int) -> None:
        """Keeps what the training goes on from, and every agent that is well."""
        self.updates = update
        if self.kind == "bcq":
            metadata = self.metadata(self.names[0])
        else:
            metadata = {"kind": self.kind, "names": self.names, "updates": update}
            metadata |= {"evaluations": self.evaluations, "diverged": self.diverged}
            metadata["settings"] = deciding_settings(self.config)
        options = {"device": self.config.device, "keep": self.config.keep_checkpoints}
        keep_training(self.path, self.loss, self.optimizers, metadata, **options)
        if self.kind != "bcq":
            for name in self.well:
                self.save_agent(name)

    def save_agent(self, name: str) -> None:
        """Keeps a member of a stack on its own, for those who only read it."""
        state = {"module": self.agent(name).state_dict()}
        save_checkpoint(self.checkpoint(name), state, self.metadata(name))

    def keep_best(self, name: str, update: int) -> None:
        """Keeps an agent's networks if its last epoch's mean return is its highest so far."""
        returns: dict[int, list[float]] = {}
        for row in self.evaluations[name]:
            returns.setdefault(row["epoch"], []).append(row["return"])
        means = [sum(values) / len(values) for values in returns.values()]
        if means[-1] == max(means):
            state = {"module": self.agent(name).state_dict()}
            metadata = self.metadata(name) | {"updates": update}
            save_checkpoint(self.folder / name / "best.safetensors", state, metadata)

    def metadata(self, name: str) -> dict[str, Any]:
        """What an agent's checkpoint says of it."""
        return {
            "kind": "bcq",
            "task": self.agents[name],
            "loss": self.options,
            "updates": self.updates,
            "evaluations": self.evaluations[name],
            "settings": deciding_settings(self.config),
            "statistics": {key: x.tolist() for key, x in vars(self.statistics).items()},
        }
