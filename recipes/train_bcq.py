"""Stage 1: one Batch-Constrained Q-learning agent per task, from demonstrations alone.

python recipes/train_bcq.py run_dir=runs/mine           # after recipes/collect.py
python recipes/train_bcq.py preset=smoke tasks=[lift]
python recipes/train_bcq.py --multirun run_dir=runs/mine workers=1 only=[reach],[lift]
python recipes/train_bcq.py run_dir=runs/mine device=cuda bcq.stacked=true cudagraphs=true
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from statistics import fmean

import hydra
from bcq_agents import Agents
from omegaconf import DictConfig
from settings import Config, run_recipe, tell
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Adam
from torchrl.data import ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_bmrl.data import make_multi_task_replay_buffer, make_replay_buffer
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.envs.transforms import ObservationStatistics, make_env
from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.files import write_rows
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.run.folder import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.training import (
    Update,
    accelerate,
    gradient_step,
    keep_freed_memory,
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


def choose_updates(
    config: Config, loss: LossModule, optimizers: dict[str, Adam], targets: SoftUpdate
) -> Callable[[int], Update]:
    """From an update's number, the first being 1, to what it does: at first the generator alone."""

    def accelerated(*networks: str) -> Update:
        chosen = {name: optimizers[name] for name in networks}
        update = make_update(loss, chosen, targets, config.bcq.critic_grad_clip)
        return accelerate(
            update, compiled=config.compile, captured=config.cudagraphs, device=config.device
        )

    whole, warmup = accelerated(*optimizers), config.bcq.generator_warmup
    warm_up = accelerated("generator") if warmup else whole
    return lambda number: warm_up if number <= warmup else whole


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
    keep_freed_memory()
    kept = Agents(config, agents, statistics)
    kept.load()
    if kept.updates:
        tell(config, f"bcq {', '.join(agents)}: goes on from update {kept.updates}")
        report(kept.updates * len(agents))
    if kept.updates < config.bcq.epochs * config.bcq.updates_per_epoch:
        train_on(config, kept, buffer, statistics, report)
    if kept.diverged:
        raise BMRLError("; ".join(kept.diverged.values()))


def train_on(
    config: Config,
    kept: Agents,
    buffer: ReplayBuffer,
    statistics: ObservationStatistics,
    report: Report,
) -> None:
    """Updates from the last one kept to the end, with rollouts after every epoch."""
    settings, agents = config.bcq, kept.agents
    total = settings.epochs * settings.updates_per_epoch

    choose = choose_updates(config, kept.loss, kept.optimizers, kept.targets)
    run_dir = Path(config.run_dir)
    loggers = {
        name: make_logger(config.logger, run_dir, f"bcq_{name}", kept.updates) for name in agents
    }
    update = kept.updates
    try:
        for update in range(kept.updates + 1, total + 1):
            batch = buffer.sample().select(*kept.loss.in_keys)
            metrics = choose(update)(batch)
            saving = update % config.checkpoint_interval == 0 or update == total
            logging = update % config.log_interval == 0
            if logging or saving:  # the only places that wait for the device
                for name, row in kept.healthy(metrics, batch, update).items():
                    log_metrics(loggers[name] if logging else None, row, update)
            if update % settings.updates_per_epoch == 0:
                epoch = update // settings.updates_per_epoch
                for name in kept.well:
                    loss, rows = kept.agent(name), kept.evaluations[name]
                    rows += evaluate_epoch(config, agents[name], loss, statistics, epoch, update)
                    write_rows(kept.folder / name / "evaluations.csv", rows)
                    kept.keep_best(name, update)
                    mean = fmean(row["return"] for row in rows if row["epoch"] == epoch)
                    tell(config, f"bcq {name}: mean return {mean:.1f} after epoch {epoch}")
            if saving:
                kept.save(update)
            report(len(agents))
    except StoppedError:
        if kept.updates < update:
            kept.healthy(metrics, batch, update)
            kept.save(update)
        raise
    finally:
        for logger in loggers.values():
            close_logger(logger)


def evaluate_epoch(config, task, loss, statistics, epoch, update) -> list[dict]:
    """Rollouts after an epoch, on the same starts every time, for the curves."""
    count = config.bcq.eval_episodes
    seeds = [derive_seed(config.seed, "curve", task, i) for i in range(count)]
    policy = BCQPolicy.frozen(loss, num_candidates=config.evaluate.num_candidates).to("cpu")
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
    """Trains the agents of every task or of ``only`` some.

    They get one process each, or are all stacked in this one.
    """
    agents = {
        task if seed == 0 else f"{task}-{seed}": task
        for seed in range(config.bcq.seeds)
        for task in config.only or config.tasks
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
    run_recipe(config, train_all, splits=True)


if __name__ == "__main__":
    main()
