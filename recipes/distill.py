"""Stage 2: the agents of all tasks into one policy conditioned on a learned embedding.

python recipes/distill.py run_dir=runs/mine             # after recipes/train_bcq.py
python recipes/distill.py preset=literal run_dir=runs/literal
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import math
from copy import deepcopy
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from settings import Config, deciding_settings, run_recipe, tell
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.data import make_multi_task_replay_buffer, with_previous
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.errors import StoppedError
from torchrl_bmrl.functional import nonzero_scale, sample_action_latent
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.pipeline.agents import Student, load_bcq_loss, make_distillation_loss
from torchrl_bmrl.run.folder import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.training import (
    accelerate,
    gradient_step,
    keep_freed_memory,
    make_adam,
)
from torchrl_bmrl.training.checkpoint import keep_training, resume_training
from torchrl_bmrl.training.health import check_metrics, check_proposals

LOSS_SETTINGS = (
    "context",
    "context_fraction",
    "context_size",
    "encoder_terms",
    "metric_weight",
    "metric_margin",
    "isometry_weight",
    "classification_weight",
    "generator_weight",
    "direction_weight",
    "qvalue_weight",
    "latent_norm_weight",
)


def load_teachers(config: Config) -> list[BCQLoss]:
    """The trained agent of every task."""
    folder = Path(config.run_dir) / "bcq"
    return [load_bcq_loss(folder / task / "checkpoint.safetensors")[0] for task in config.tasks]


def value_statistics(
    teachers: list[BCQPolicy], datasets: list[TensorDictBase]
) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each teacher's value on its own data, ``(num_tasks,)``."""
    values = [
        teacher.qvalue_network(data.select("observation", "action")).get("state_action_value")
        for teacher, data in zip(teachers, datasets, strict=True)
    ]
    return torch.stack([v.mean() for v in values]), torch.stack([spread(v) for v in values])


def spread(values: Tensor) -> Tensor:
    """Standard deviation of a task's numbers, ``(N, 1)``; 1 where they are all the same."""
    deviation = values.std() if len(values) > 1 else torch.zeros_like(values).sum()
    return nonzero_scale(deviation, values.abs().max(), values.dtype)


def train_student(config: Config, report: Report) -> None:
    """Trains the student, or goes on from its checkpoint."""
    keep_freed_memory()
    settings, run_dir = config.distill, Path(config.run_dir)
    path = run_dir / "distill" / "checkpoint.safetensors"
    statistics = read_statistics(run_dir / "data")
    train, valid = (
        [
            load_transitions(run_dir / "data", task, statistics, split=split, num_task=i)
            for i, task in enumerate(config.tasks)
        ]
        for split in ("train", "valid")
    )
    if settings.context == "previous":
        train = [with_previous(data, TRANSITION_KEYS) for data in train]
    buffer = make_multi_task_replay_buffer(
        train, batch_size=settings.batch_size, device=config.device
    )

    torch.manual_seed(derive_seed(config.seed, "distill"))
    losses = load_teachers(config)
    teachers = [BCQPolicy.frozen(loss) for loss in losses]
    options = {
        "num_tasks": len(config.tasks),
        "task_encoder": settings.task_encoder,
        "task_latent_dim": settings.task_latent_dim,
        "num_cells": settings.num_cells,
        "latent_dim": teachers[0].latent_dim,
    }
    student = Student(**options)
    normalisation = value_statistics(teachers, train) if settings.normalise_qvalue else (None, None)
    loss = make_distillation_loss(
        student,
        teachers,
        qvalue_loc=normalisation[0],
        qvalue_scale=normalisation[1],
        reward_scale=torch.stack([spread(data["next", "reward"]) for data in train]),
        **{name: getattr(settings, name) for name in LOSS_SETTINGS},
    ).to(config.device)
    optimizer = make_adam(loss.parameters(), lr=settings.lr)
    kept = resume_training(
        path, student, {"student": optimizer}, kind="student", device=config.device
    )
    done = kept["updates"] if kept else 0
    if done:
        tell(config, f"distillation: goes on from update {done}")
        report(done)
    if done == settings.updates:
        return
    logger = make_logger(config.logger, run_dir, "distill", done)

    def step(batch: TensorDictBase) -> dict[str, Tensor]:
        losses = loss(batch)
        total = sum(term for name, term in losses.items() if name.startswith("loss_"))
        gradient_step(optimizer, total)
        return {name: value.detach() for name, value in losses.items()}

    step = accelerate(
        step, compiled=config.compile, captured=config.cudagraphs, device=config.device
    )

    def check(metrics: dict[str, Tensor], batch: TensorDictBase, update: int) -> None:
        where = f"distillation, update {update}"
        check_metrics(metrics, where)
        some = batch[:, :32]
        proposed = proposals(student, some, teachers[0].latent_clip, config.device)
        check_proposals(proposed, some["action"], where)

    def save(update: int) -> None:
        own = student if config.device == "cpu" else deepcopy(student).to("cpu")
        own.set_prototypes(train, settings.prototype)
        metadata = {
            "kind": "student",
            "tasks": config.tasks,
            "student": options,
            "latent_clip": teachers[0].latent_clip,
            "updates": update,
            "accuracy": own.accuracy(torch.cat(valid)),
            "settings": deciding_settings(config),
            "statistics": {name: x.tolist() for name, x in vars(statistics).items()},
        }
        keeping = {"device": config.device, "keep": config.keep_checkpoints}
        keep_training(path, own, {"student": optimizer}, metadata, **keeping)
        tell(config, f"distillation: update {update} kept, accuracy {metadata['accuracy']:.1%}")

    update = saved = done
    try:
        for update in range(done + 1, settings.updates + 1):
            if settings.cosine:  # from lr to zero
                share = (update - 1) / settings.updates
                rate = settings.lr * (1 + math.cos(math.pi * share)) / 2
                optimizer.param_groups[0]["lr"].fill_(rate)
            batch = buffer.sample()
            metrics = step(batch.select(*loss.in_keys))
            saving = update % config.checkpoint_interval == 0 or update == settings.updates
            logging = update % config.log_interval == 0
            if logging or saving:
                check(metrics, batch, update)
                log_metrics(logger if logging else None, metrics, update)
            if saving:
                save(saved := update)
            report(1)
    except StoppedError:
        if saved < update:
            check(metrics, batch, update)
            save(update)
        raise
    finally:
        close_logger(logger)


@torch.no_grad()
def proposals(
    student: Student, batch: TensorDictBase, latent_clip: float | None, device: str
) -> Tensor:
    """Candidates of the student, ``(num_tasks, B, candidates, action_dim)``."""
    data = batch.select("observation").set("task_latent", student.embed(batch))
    data = data.unsqueeze(-1).expand(*data.batch_size, 10)
    on_gpu = torch.device(device).type == "cuda"
    # Training draws the same random numbers whether or not it is looked at.
    with torch.random.fork_rng([torch.device(device)] if on_gpu else []):
        latent = sample_action_latent(
            (*data.batch_size, student.latent_dim), latent_clip=latent_clip, device=device
        )
    return student.generator(data.set("action_latent", latent))["action"]


def distill(config: Config) -> None:
    """Stage 2 under a progress bar."""
    run_jobs(
        train_student,
        [config],
        workers=1,
        total=config.distill.updates,
        description="stage 2: distilling",
        unit="update",
    )


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, distill)


if __name__ == "__main__":
    main()
