"""Trains models of the tasks' rewards, which relabel transitions of other tasks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_bmrl.data import make_multi_task_replay_buffer
from torchrl_bmrl.modules import make_reward_models
from torchrl_bmrl.objectives import RewardModelLoss
from torchrl_bmrl.pipeline.learners import sizes_of
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import DistillSettings
from torchrl_bmrl.pipeline.training import Training, make_update
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.training.update import make_adam

MODELS: dict[str, Any] = {"num_models": 3, "num_cells": (128, 128), "reads_next": True}
"""Options of the models that relabel contexts."""


def train_reward_models(
    run: Run,
    folder: str,
    models: TensorDictModule,
    datasets: Sequence[TensorDictBase],
    report: Report,
    *,
    updates: int,
    batch_size: int,
    lr: float,
) -> None:
    """Trains the models in place, or goes on from the checkpoint.

    Args:
        run: the run.
        folder: of the checkpoint, below the run's folder.
        models: :func:`torchrl_bmrl.modules.make_reward_models`'s module.
        datasets: transitions of each task, ``[N_i]`` each.
        report: called with the number of new updates.
        updates: number of all updates.
        batch_size: transitions of each task per update.
        lr: learning rate of the first update; it decays to zero.

    Raises:
        BMRLError: if the training diverges.
    """
    device = run.settings.device
    loss = RewardModelLoss(models).to(device)
    optimizer = make_adam(loss.parameters(), lr=lr)
    buffer = make_multi_task_replay_buffer(list(datasets), batch_size=batch_size, device=device)
    training = Training(
        run,
        folder,
        "rewards",
        models,
        {"rewards": optimizer},
        {"rewards": lr},
        rewards=[data["next", "reward"] for data in datasets],
    )
    training.train(
        make_update(loss, optimizer),
        lambda: buffer.sample().select(*loss.in_keys),
        updates,
        report,
    )


def models_for_contexts(
    run: Run,
    folder: str,
    distill: DistillSettings,
    datasets: Sequence[TensorDictBase],
    report: Report,
) -> TensorDictModule:
    """Trained models for :class:`.ContextSampler`, on the CPU.

    PyTorch's global random state does not change, so that an interrupted training of a student goes
    on as if the models had always been there.

    Args:
        run: the run.
        folder: of the student, below the run's folder.
        distill: settings of stage 2.
        datasets: all transitions of each task, ``[N_i]`` each.
        report: called with the number of new updates.
    """
    with torch.random.fork_rng():
        torch.manual_seed(run.seed(folder, "rewards"))
        models = make_reward_models(len(datasets), *sizes_of(datasets[0]).values(), **MODELS)
        models.module.set_scales(*datasets)
        train_reward_models(
            run,
            f"{folder}/rewards",
            models,
            datasets,
            report,
            updates=distill.reward_updates,
            batch_size=distill.batch_size,
            lr=distill.lr,
        )
    return models.to("cpu").requires_grad_(False)
