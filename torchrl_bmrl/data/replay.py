"""Demonstrations as TensorDicts, and replay buffers over one task or all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import (
    LazyMemmapStorage,
    ReplayBufferEnsemble,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.samplers import RandomSampler, SamplerEnsemble
from torchrl.data.replay_buffers.storages import StorageEnsemble
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter, WriterEnsemble

from torchrl_bmrl.errors import BMRLError


def stack_episodes(episodes: Sequence[Mapping[str, Any]], *, task: int) -> TensorDict:
    """Episodes one after the other, in TorchRL's layout.

    The last step of an episode is ``truncated``, never ``terminated``: the horizon ends it, and its
    value bootstraps through.

    Args:
        episodes: dicts with ``obs`` and ``next_obs`` (dicts of ``(T, n)``), ``actions (T, a)``,
            ``rewards (T,)`` and ``successes (T,)``, as
            :func:`torchrl_bmrl.data.robomimic.read_demonstrations` returns them.
        task: class index written to ``task``.

    Returns:
        batch ``[N]``: the named parts of the observation and the same under ``"next"`` (float64),
        ``action``, ``("next", "reward")``, ``("next", "done")``, ``("next", "terminated")``,
        ``("next", "truncated")``, ``("next", "success")`` each ``(N, 1)``, and ``task``,
        ``episode``, ``step`` ``(N,)`` int64.

    Raises:
        BMRLError: without episodes.

    Example:
        >>> part = np.zeros((5, 3))
        >>> episode = {
        ...     "obs": {"x": part},
        ...     "next_obs": {"x": part},
        ...     "actions": np.zeros((5, 2)),
        ...     "rewards": np.zeros(5),
        ...     "successes": np.zeros(5, bool),
        ... }
        >>> data = stack_episodes([episode, episode], task=1)
        >>> data.batch_size, data["next", "truncated"].sum().item()
        (torch.Size([10]), 2)
    """
    if not episodes:
        raise BMRLError("no episodes; valid: at least one")

    def column(name: str) -> Tensor:
        return torch.as_tensor(np.concatenate([episode[name] for episode in episodes]))

    def parts(group: str) -> dict[str, Tensor]:
        return {
            name: torch.as_tensor(np.concatenate([episode[group][name] for episode in episodes]))
            for name in episodes[0][group]
        }

    lengths = [len(episode["actions"]) for episode in episodes]
    step = torch.cat([torch.arange(length) for length in lengths])
    last = torch.cat([torch.arange(length) == length - 1 for length in lengths]).unsqueeze(-1)
    return TensorDict(
        {
            **parts("obs"),
            "action": column("actions").float(),
            "task": torch.full_like(step, task),
            "episode": torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths)),
            "step": step,
            "next": {
                **parts("next_obs"),
                "reward": column("rewards").float().unsqueeze(-1),
                "done": last,
                "terminated": torch.zeros_like(last),
                "truncated": last.clone(),
                "success": column("successes").bool().unsqueeze(-1),
            },
        },
        batch_size=[len(step)],
    )


def with_previous(data: TensorDictBase, keys: Sequence[Any]) -> TensorDictBase:
    """Adds to each transition the one before it in its episode, under ``"previous"``.

    The first transition of an episode is its own predecessor.

    Args:
        data: batch ``[N]`` in the order of the episodes, with ``step``.
        keys: the keys of a transition to copy.

    Example:
        >>> data = TensorDict({"step": torch.tensor([0, 1, 0]), "x": torch.arange(3)}, [3])
        >>> with_previous(data, ["x"])["previous", "x"]
        tensor([0, 0, 2])
    """
    index = torch.arange(len(data)) - (data.get("step") > 0).long()
    return data.copy().set("previous", data.select(*keys)[index])


def make_replay_buffer(
    data: TensorDictBase, *, batch_size: int, scratch_dir: str | None = None
) -> TensorDictReplayBuffer:
    """Memory-mapped buffer that samples single transitions with replacement.

    Args:
        data: batch ``[N]``.
        batch_size: transitions a sample.
        scratch_dir: where the memory map lies; a temporary folder by default.

    Raises:
        BMRLError: for numbers that are not finite. Losses look for them on CPU only: elsewhere
            that would wait for the device.

    Example:
        >>> buffer = make_replay_buffer(TensorDict({"x": torch.arange(10)}, [10]), batch_size=4)
        >>> buffer.sample().batch_size
        torch.Size([4])
    """
    for key, value in data.items(include_nested=True, leaves_only=True):
        if value.is_floating_point() and not value.isfinite().all():
            row = int((~value.isfinite()).nonzero()[0, 0])
            raise BMRLError(f"{key!r} is not finite in transition {row}; valid: finite numbers")
    buffer = TensorDictReplayBuffer(
        storage=LazyMemmapStorage(len(data), scratch_dir=scratch_dir), batch_size=batch_size
    )
    buffer.extend(data)
    return buffer


def make_multi_task_replay_buffer(
    datasets: Sequence[TensorDictBase], *, batch_size: int
) -> ReplayBufferEnsemble:
    """Buffer whose every sample holds ``batch_size`` transitions of every task.

    Args:
        datasets: one batch ``[N_i]`` per task, in the order of the tasks.
        batch_size: transitions a task and sample.

    Returns:
        a buffer whose samples have the batch size ``[num_tasks, batch_size]``, row i of task i.

    Example:
        >>> tasks = [TensorDict({"task": torch.full((10,), i)}, [10]) for i in range(3)]
        >>> make_multi_task_replay_buffer(tasks, batch_size=2).sample()["task"].tolist()
        [[0, 0], [1, 1], [2, 2]]
    """
    buffers = [make_replay_buffer(data, batch_size=batch_size) for data in datasets]
    return ReplayBufferEnsemble(
        storages=StorageEnsemble(*(buffer.storage for buffer in buffers), transforms=None),
        samplers=SamplerEnsemble(*(RandomSampler() for _ in buffers), sample_from_all=True),
        writers=WriterEnsemble(*(ImmutableDatasetWriter() for _ in buffers)),
        batch_size=batch_size * len(buffers),
    )
