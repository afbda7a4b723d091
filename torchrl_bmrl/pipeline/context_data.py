"""Samples contexts: sets of transitions of one task and one behaviour."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.modules import as_context
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS

ONE_EPISODE = 0.7
"""Share of the contexts that are of one episode; the others mix the episodes of a behaviour."""


class ContextSampler:
    """Draws, for each task, one context of its demonstrations and two of another behaviour.

    A context leaves out a random share of its transitions, so that an encoder learns from few and
    from many.

    Args:
        own: demonstrations of each task, ``[N_i]`` each, with ``episode (N_i,)``.
        others: episodes of another behaviour, likewise.
        size: transitions of a context.

    Example:
        >>> from tensordict import TensorDict
        >>> after = {"observation": torch.randn(6, 3), "reward": torch.randn(6, 1)}
        >>> data = {"observation": torch.randn(6, 3), "action": torch.randn(6, 2), "next": after}
        >>> data["episode"] = torch.tensor([0, 0, 0, 1, 1, 1])
        >>> task = TensorDict(data, [6])
        >>> ContextSampler([task, task], [task, task], 4)()["context"].shape
        torch.Size([2, 3, 4])
    """

    def __init__(
        self, own: Sequence[TensorDictBase], others: Sequence[TensorDictBase], size: int
    ) -> None:
        self.size = size
        self.data = torch.cat([data.select(*TRANSITION_KEYS) for data in (*own, *others)])
        first, second = _episodes(own, 0), _episodes(others, sum(map(len, own)))
        self.behaviours = (first, second, second)

    def __call__(self) -> TensorDictBase:
        """Returns contexts, ``[num_tasks, 3]``."""
        rows = torch.stack([self._rows(*behaviour) for behaviour in self.behaviours], 1)
        contexts = self.data[rows]
        share = torch.rand(*rows.shape[:2], 1)
        mask = torch.rand(rows.shape) < share
        mask[..., 0] = True
        return as_context(contexts, mask)

    def _rows(self, start: Tensor, length: Tensor, count: Tensor) -> Tensor:
        """Rows of one context of each task, ``(num_tasks, size)``."""
        shape = (len(count), self.size)
        episode = (torch.rand(shape) * count.unsqueeze(-1)).long()
        one = torch.rand(len(count), 1) < ONE_EPISODE
        episode = torch.where(one, episode[:, :1], episode)
        step = torch.rand(shape, dtype=torch.float64) * length.gather(1, episode)
        return start.gather(1, episode) + step.long()


def _episodes(datasets: Sequence[TensorDictBase], offset: int) -> tuple[Tensor, Tensor, Tensor]:
    """First row and length of each episode, ``(num_tasks, E)``, and the tasks' numbers of them."""
    starts, lengths = [], []
    for data in datasets:
        _, length = data["episode"].unique_consecutive(return_counts=True)
        starts.append(offset + length.cumsum(0) - length)
        lengths.append(length)
        offset += len(data)
    pad = torch.nn.utils.rnn.pad_sequence
    counts = torch.tensor([len(length) for length in lengths])
    return pad(starts, batch_first=True), pad(lengths, batch_first=True), counts
