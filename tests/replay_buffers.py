"""Small replay buffers of every kind, and the numbered transitions that they hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from torchrl_bmrl.data import (
    make_mixed_replay_buffer,
    make_multi_task_replay_buffer,
    make_replay_buffer,
)

SIZES = (30, 5, 12)


def numbered(start: int, rows: int, task: int = 0) -> TensorDict:
    return TensorDict(
        {
            "number": torch.arange(start, start + rows),
            "task": torch.full((rows,), task),
            "next": {"double": 2.0 * torch.arange(start, start + rows)},
        },
        batch_size=[rows],
    )


def tasks() -> list[TensorDict]:
    return [numbered(1000 * i, rows, task=i) for i, rows in enumerate(SIZES)]


def episodes() -> TensorDict:
    """Three episodes of 4, 1 and 3 steps."""
    step = torch.tensor([0, 1, 2, 3, 0, 0, 1, 2])
    episode = torch.tensor([0, 0, 0, 0, 1, 2, 2, 2])
    time = (100.0 * episode + step).unsqueeze(-1)
    return TensorDict(
        {
            "x": time,
            "action": time.expand(8, 7) / 1000,
            "episode": episode,
            "step": step,
            "next": {"x": time + 1, "reward": time.clone()},
        },
        batch_size=[8],
    )


def single(**options: Any) -> TensorDictReplayBuffer:
    return make_replay_buffer(numbered(0, 50), batch_size=8, **options)


def multi_task(datasets: Any = None, **options: Any) -> TensorDictReplayBuffer:
    datasets = tasks() if datasets is None else datasets
    return make_multi_task_replay_buffer(datasets, batch_size=8, **options)


def weighted(**options: Any) -> TensorDictReplayBuffer:
    return multi_task(**{"weights": [1, 2, 1], **options})


def mixed(datasets: Any = None, **options: Any) -> TensorDictReplayBuffer:
    datasets = tasks() if datasets is None else datasets
    return make_mixed_replay_buffer(datasets, batch_size=8, **{"weights": [1, 0, 3], **options})


BUFFERS = (single, multi_task, weighted, mixed)
Make = Callable[..., TensorDictReplayBuffer]
every_buffer = pytest.mark.parametrize("make", BUFFERS, ids=lambda make: make.__name__)
every_ensemble = pytest.mark.parametrize("make", [multi_task, mixed], ids=lambda m: m.__name__)


def draw(buffer: TensorDictReplayBuffer, seed: int) -> torch.Tensor:
    torch.manual_seed(seed)
    return torch.stack([buffer.sample()["number"] for _ in range(4)])
