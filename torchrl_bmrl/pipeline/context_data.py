"""Samples contexts: sets of transitions of one task and one behaviour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.modules import as_context
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS

ONE_EPISODE = 0.7
"""Share of the contexts that are of one episode; the others mix the episodes of a behaviour."""
RELABELLED = 0.7
"""Share of the contexts of other behaviour that are another task's, with rewards of a model."""


class ContextSampler:
    """Draws, for each task, one context of its demonstrations and two of another behaviour.

    A context leaves out a random share of its transitions, so that an encoder learns from few and
    from many. With ``reward_models``, a context of other behaviour is often that of another task
    with the rewards that the own task would give: the same motion then belongs to every task, and
    only rewards tell the task.

    Args:
        own: demonstrations of each task, ``[N_i]`` each, with ``episode (N_i,)``.
        others: episodes of another behaviour, likewise.
        size: transitions of a context.
        reward_models: of each task, :func:`torchrl_bmrl.modules.make_reward_models`'s module;
            ``None`` for contexts as they were recorded.

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
        self,
        own: Sequence[TensorDictBase],
        others: Sequence[TensorDictBase],
        size: int,
        reward_models: TensorDictModule | None = None,
    ) -> None:
        self.size, self.reward_models = size, reward_models
        self.data = torch.cat([data.select(*TRANSITION_KEYS) for data in (*own, *others)])
        first, second = _episodes(own, 0), _episodes(others, sum(map(len, own)))
        self.behaviours = (first, second, second)

    def __call__(self) -> TensorDictBase:
        """Returns contexts, ``[num_tasks, 3]``."""
        rows = torch.stack([self._rows(*behaviour) for behaviour in self.behaviours], 1)
        contexts = self.data[rows]
        if self.reward_models is not None:
            contexts[:, 1:] = self._relabelled(rows[:, 1:], contexts[:, 1:])
        share = torch.rand(*rows.shape[:2], 1)
        mask = torch.rand(rows.shape) < share
        mask[..., 0] = True
        return as_context(contexts, mask)

    @torch.no_grad()
    def _relabelled(self, rows: Tensor, contexts: TensorDictBase) -> TensorDictBase:
        """Contexts ``[num_tasks, C]``, of which some are lent by other tasks."""
        assert self.reward_models is not None
        shape = rows.shape[:2]
        chosen = torch.rand(shape) < RELABELLED
        lender = torch.randint(shape[0], shape)
        lent = cast(TensorDictBase, self.data[rows[lender, torch.arange(shape[1])]])
        read = lent.select(*self.reward_models.in_keys).flatten(1, 2)
        reward = self.reward_models(read)["reward_prediction"].mean(-1, keepdim=True)
        lent.set(("next", "reward"), reward.unflatten(1, rows.shape[1:]))
        return torch.where(chosen.unsqueeze(-1), lent, contexts)

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
