"""Stage 1: one Batch-Constrained Q-learning agent per task, from demonstrations alone.

python recipes/train_bcq.py run_dir=runs/mine           # after recipes/collect.py
python recipes/train_bcq.py preset=smoke tasks=[lift]
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from contextlib import closing
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from settings import Config, run_recipe
from torch.nn.utils import clip_grad_norm_
from torchrl.data import ReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.agents import make_bcq_loss
from torchrl_bmrl.checkpoint import load_checkpoint, load_state, save_checkpoint
from torchrl_bmrl.data import make_replay_buffer
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.envs.transforms import ObservationStatistics, make_env
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.files import write_rows
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.parallel import Report, derive_seed, run_jobs
from torchrl_bmrl.runs import check_finite, log_metrics, make_logger

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


def train_task(job: tuple[Config, str], report: Report) -> None:
    """Trains one task's agent, or goes on from its checkpoint."""
    config, task = job
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    data = load_transitions(
        data_dir, task, statistics, split="train", num_task=config.tasks.index(task)
    )
    buffer = make_replay_buffer(data, batch_size=config.bcq.batch_size)
    train_agent(config, task, task, buffer, statistics, report)


def train_agent(
    config: Config,
    task: str,
    name: str,
    buffer: ReplayBuffer,
    statistics: ObservationStatistics,
    report: Report,
) -> None:
    """Trains the agent that is kept under ``bcq/<name>``, or goes on from its checkpoint."""
    settings, run_dir = config.bcq, Path(config.run_dir)
    path = run_dir / "bcq" / name / "checkpoint.safetensors"
    total = settings.epochs * settings.updates_per_epoch
    torch.manual_seed(derive_seed(config.seed, "bcq", name))
    options = {option: getattr(settings, option) for option in LOSS_SETTINGS}
    loss = make_bcq_loss(**options)
    target_updater = SoftUpdate(loss, tau=settings.tau)
    parts = {"generator": loss.generator_loss, "qvalue": loss.qvalue_loss}
    networks = {"generator": loss.generator_params, "qvalue": loss.qvalue_network_params}
    if settings.perturbation:
        parts["perturbation"] = loss.perturbation_loss
        networks["perturbation"] = loss.perturbation_network_params
    optimizers = {
        network: torch.optim.Adam(params.parameters(), lr=settings.lr)
        for network, params in networks.items()
    }
    done, evaluations = 0, []
    if path.exists():
        state, metadata = load_checkpoint(path, kind="bcq")
        load_state(loss, state["loss"], path)
        for network, optimizer in optimizers.items():
            optimizer.load_state_dict(state["optimizers"][network])
        torch.set_rng_state(state["rng"])
        done, evaluations = metadata["updates"], metadata["evaluations"]
        report(done)
    logger = make_logger(config.logger, run_dir, f"bcq_{name}") if done < total else None

    for update in range(done + 1, total + 1):
        batch = buffer.sample()
        metrics = {}
        for network, part in parts.items():  # in update order: generator, critics, perturbation
            if network != "generator" and update <= settings.generator_warmup:
                continue
            value, info = part(batch)
            optimizers[network].zero_grad(set_to_none=True)
            value.backward()
            if network == "qvalue" and settings.critic_grad_clip is not None:
                clip_grad_norm_(networks[network].parameters(), settings.critic_grad_clip)
            optimizers[network].step()
            metrics |= {f"loss_{network}": value.detach()} | info
        target_updater.step()
        report(1)
        if update % config.log_interval == 0:
            metrics.pop("td_error", None)  # one number per transition
            check_finite(metrics, f"bcq {name}, update {update}")
            log_metrics(logger, metrics, update)
        if update % settings.updates_per_epoch == 0:
            epoch = update // settings.updates_per_epoch
            evaluations += evaluate_epoch(config, task, loss, statistics, epoch, update)
            write_rows(path.with_name("evaluations.csv"), evaluations)
        if update % config.checkpoint_interval == 0 or update == total:
            state = {
                "loss": loss.state_dict(),
                "optimizers": {network: o.state_dict() for network, o in optimizers.items()},
                "rng": torch.get_rng_state(),
            }
            metadata = {
                "kind": "bcq",
                "task": task,
                "loss": options,
                "updates": update,
                "evaluations": evaluations,
                "statistics": {key: x.tolist() for key, x in vars(statistics).items()},
            }
            save_checkpoint(path, state, metadata)


def evaluate_epoch(config, task, loss, statistics, epoch, update) -> list[dict]:
    """Rollouts after an epoch, on the same starts every time, for the curves."""
    count = config.bcq.eval_episodes
    seeds = [derive_seed(config.seed, "curve", task, i) for i in range(count)]
    policy = BCQPolicy.from_loss(loss, num_candidates=config.evaluate.num_candidates)
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
    """Trains every task's agent, one process each."""
    updates = config.bcq.epochs * config.bcq.updates_per_epoch
    run_jobs(
        train_task,
        [(config, task) for task in config.tasks],
        workers=config.workers,
        total=updates * len(config.tasks),
        description="stage 1: training BCQ",
        unit="update",
    )


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, train_all)


if __name__ == "__main__":
    main()
