"""Stage 1: one Batch-Constrained Q-learning agent per task, from demonstrations alone.

python recipes/train_bcq.py run_dir=runs/mine           # after recipes/collect.py
python recipes/train_bcq.py preset=smoke tasks=[lift]
python recipes/train_bcq.py run_dir=runs/mine device=cuda bcq.stacked=true cudagraphs=true
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Adam
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate
from tqdm import tqdm

from torchrl_bmrl.agents import make_bcq_loss
from torchrl_bmrl.checkpoint import load_checkpoint, load_state, save_checkpoint
from torchrl_bmrl.data import make_multi_task_replay_buffer, make_replay_buffer
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.envs.transforms import ObservationStatistics, make_env
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.files import write_rows
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.parallel import Report, derive_seed, run_jobs
from torchrl_bmrl.runs import check_finite, log_metrics, make_logger
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
    "target_dtype",
    "loss_function",
)


def train_job(job: tuple[Config, dict[str, str]], report: Report) -> None:
    """Trains agents on their tasks' demonstrations, or goes on from their checkpoint.

    Args:
        job: the settings, and of each agent its name and its task.
        report: called with the number of updates done since its last call.
    """
    config, agents = job
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    datasets = [
        load_transitions(
            data_dir, task, statistics, split="train", num_task=config.tasks.index(task)
        )
        for task in agents.values()
    ]
    options = {"batch_size": config.bcq.batch_size, "device": config.device}
    if len(agents) == 1:
        buffer = make_replay_buffer(datasets[0], **options)
    else:
        buffer = make_multi_task_replay_buffer(datasets, **options)
    train_agents(config, agents, buffer, statistics, report)


def make_update(
    loss: LossModule, optimizers: dict[str, Adam], targets: SoftUpdate, max_norm: float | None
) -> Update:
    """One update of every network that has an optimizer, in their order, and of the targets."""

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        metrics = {}
        for network, optimizer in optimizers.items():
            value, info = getattr(loss, f"{network}_loss")(batch)
            gradient_step(optimizer, value, max_norm if network == "qvalue" else None)
            metrics |= {f"loss_{network}": value.detach()} | info
        targets.step()
        metrics.pop("td_error", None)  # one number per transition
        return metrics

    return update


class Training:
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

    def finite(self, metrics: dict[str, Tensor], update: int) -> dict[str, dict[str, float]]:
        """Every agent's metrics; one whose are not finite is said and left as it was kept last."""
        columns = {key: torch.atleast_1d(value).tolist() for key, value in metrics.items()}
        rows = {}
        for name in self.well:
            i = self.names.index(name)
            rows[name] = {key: column[i] for key, column in columns.items()}
            try:
                check_finite(rows[name], f"bcq {name}, update {update}")
            except BMRLError as error:
                self.diverged[name] = str(error)
                if not self.well:
                    raise
                tqdm.write(f"{error}; it is frozen and the others go on", file=sys.stderr)
                del rows[name]
        return rows

    def load(self) -> None:
        """Goes on from what was kept, if anything was."""
        if not self.path.exists():
            return
        state, metadata = load_checkpoint(self.path, kind=self.kind)
        load_state(self.loss, state["loss"], self.path)
        for name, optimizer in self.optimizers.items():
            load_adam(optimizer, state["optimizers"][name])
        set_rng_state(state["rng"], self.config.device)
        self.updates = metadata["updates"]
        if self.kind == "bcq":
            self.evaluations = {self.names[0]: metadata["evaluations"]}
        else:
            self.evaluations, self.diverged = metadata["evaluations"], metadata["diverged"]
            self.save_agents(self.updates)  # if a kill came in between

    def save(self, update: int) -> None:
        """Keeps what the training goes on from, and every agent that is well."""
        state = {
            "loss": self.loss.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.items()},
            "rng": get_rng_state(self.config.device),
        }
        if self.kind == "bcq":
            return save_checkpoint(self.path, state, self.metadata(self.names[0], update))
        metadata = {"kind": self.kind, "names": self.names, "updates": update}
        metadata |= {"evaluations": self.evaluations, "diverged": self.diverged}
        save_checkpoint(self.path, state, metadata)
        self.save_agents(update)

    def save_agents(self, update: int) -> None:
        """Keeps each member of a stack on its own, for those who only read it."""
        for name in self.well:
            path, metadata = self.checkpoint(name), self.metadata(name, update)
            if not path.exists() or load_checkpoint(path, kind="bcq")[1] != metadata:
                save_checkpoint(path, {"loss": self.agent(name).state_dict()}, metadata)

    def metadata(self, name: str, update: int) -> dict[str, Any]:
        """What an agent's checkpoint says of it."""
        return {
            "kind": "bcq",
            "task": self.agents[name],
            "loss": self.options,
            "updates": update,
            "evaluations": self.evaluations[name],
            "statistics": {key: x.tolist() for key, x in vars(self.statistics).items()},
        }


def train_agents(
    config: Config,
    agents: dict[str, str],
    buffer: ReplayBuffer,
    statistics: ObservationStatistics,
    report: Report,
) -> None:
    """Trains agents on samples of a buffer, ``[batch]`` for one and ``[agents, batch]`` for more.

    Raises:
        BMRLError: naming the agents that diverged, after the others are trained.
    """
    settings = config.bcq
    total = settings.epochs * settings.updates_per_epoch
    keep_freed_memory()
    training = Training(config, agents, statistics)
    training.load()

    def accelerated(*networks: str) -> Update:
        chosen = {name: training.optimizers[name] for name in networks}
        update = make_update(training.loss, chosen, training.targets, settings.critic_grad_clip)
        return accelerate(
            update, compiled=config.compile, captured=config.cudagraphs, device=config.device
        )

    update_all = accelerated(*training.optimizers)
    warm_up = accelerated("generator") if settings.generator_warmup else update_all
    if training.updates:
        report(training.updates * len(agents))
    loggers = {}
    if training.updates < total:
        run_dir = Path(config.run_dir)
        loggers = {name: make_logger(config.logger, run_dir, f"bcq_{name}") for name in agents}

    for update in range(training.updates + 1, total + 1):
        batch = buffer.sample().select(*training.loss.in_keys)
        metrics = (warm_up if update <= settings.generator_warmup else update_all)(batch)
        report(len(agents))
        saving = update % config.checkpoint_interval == 0 or update == total
        logging = update % config.log_interval == 0
        if logging or saving:  # the only places that wait for the device
            for name, row in training.finite(metrics, update).items():
                log_metrics(loggers[name] if logging else None, row, update)
        if update % settings.updates_per_epoch == 0:
            epoch = update // settings.updates_per_epoch
            for name in training.well:
                loss, rows = training.agent(name), training.evaluations[name]
                rows += evaluate_epoch(config, agents[name], loss, statistics, epoch, update)
                write_rows(training.folder / name / "evaluations.csv", rows)
        if saving:
            training.save(update)
    if training.diverged:
        raise BMRLError("; ".join(training.diverged.values()))


def evaluate_epoch(config, task, loss, statistics, epoch, update) -> list[dict]:
    """Rollouts after an epoch, on the same starts every time, for the curves."""
    count = config.bcq.eval_episodes
    seeds = [derive_seed(config.seed, "curve", task, i) for i in range(count)]
    policy = BCQPolicy.from_loss(loss, num_candidates=config.evaluate.num_candidates).to("cpu")
    env = make_env(task, statistics, num_envs=count, stepper=config.stepper)
    with closing(env):
        outcomes = evaluate_policy(env, policy, seeds)
    return [
        {
            "epoch": epoch,
            "update": update,
            "episode": i,
            "return": outcome.episode_return,
            "success": int(outcome.success),
        }
        for i, outcome in enumerate(outcomes)
    ]


def train_all(config: Config) -> None:
    """Trains every task's agents: one process each, or all of them stacked in this one."""
    agents = {
        task if seed == 0 else f"{task}-{seed}": task
        for seed in range(config.bcq.seeds)
        for task in config.tasks
    }
    stacked = config.bcq.stacked and len(agents) > 1
    jobs = [agents] if stacked else [{name: task} for name, task in agents.items()]
    run_jobs(
        train_job,
        [(config, job) for job in jobs],
        workers=config.workers,
        total=config.bcq.epochs * config.bcq.updates_per_epoch * len(agents),
        description="stage 1: training BCQ",
        unit="update",
    )


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, train_all)


if __name__ == "__main__":
    main()
