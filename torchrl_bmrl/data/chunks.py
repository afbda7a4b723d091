"""Chunks of actions: several actions in a row as one action."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_bmrl.data.n_step import MASK_KEYS, STEPS_KEY, NStep, rows_later
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.data import missing


class ActionChunks(nn.Module):
    r"""Turns transitions into transitions whose action is a chunk of the next actions.

    Row t gets the actions :math:`(a_t, \ldots, a_{t+c-1})`, one after the other in its last
    dimension, and the outcome of c steps as :class:`NStep` computes it. A critic then values whole
    chunks, so that its c-step target has no bias: all c actions belong to the chunk. A policy that
    proposes chunks plays them by :class:`torchrl_bmrl.modules.ChunkPolicy`.

    A row near the end of an episode, for which fewer than c steps are left, is dropped, unless the
    episode terminates: then its last action is repeated, which nothing executes.

    Reference: Li, Zhou and Levine, *Reinforcement Learning with Action Chunking*, 2025,
    https://arxiv.org/abs/2507.07969

    Args:
        size: c, actions of a chunk, at least 1.
        gamma: discount, between 0 and 1; the same as the loss's.
        action_key: key of the action.
        **options: names of keys of :class:`NStep`.

    Raises:
        BMRLError: for invalid options.

    Example:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([[False], [False], [True]])
        >>> after = {"reward": torch.ones(3, 1), "done": done, "terminated": done}
        >>> action = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
        >>> data = ActionChunks(2, gamma=0.5)(TensorDict({"action": action, "next": after}, [3]))
        >>> data["action"].tolist()
        [[1.0, 2.0, 3.0, 4.0], [3.0, 4.0, 5.0, 6.0], [5.0, 6.0, 5.0, 6.0]]
    """

    def __init__(
        self, size: int, gamma: float, *, action_key: NestedKey = "action", **options: Any
    ) -> None:
        super().__init__()
        self.outcome = NStep(size, gamma, **options)
        self.action_key = action_key

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Makes the transitions of chunks; the given data do not change.

        Args:
            tensordict: as for :class:`NStep`, with the action ``(*B, T, action_dim)``.

        Returns:
            the rows with a chunk, batch ``[N]``: the action ``(N, c * action_dim)``, ``"next"`` and
            ``steps_to_next_obs``.

        Raises:
            BMRLError: as :class:`NStep`, and for data without the action, or without any chunk.
        """
        data, size = self.outcome(tensordict), self.outcome.n_steps
        action = data.get(self.action_key, None)
        if action is None:
            raise missing(data, self.action_key)
        steps: Tensor = data.get(STEPS_KEY)[..., 0]
        parts = [action[rows_later(steps.clamp(max=i + 1) - 1)] for i in range(size)]
        whole = steps == size
        if (terminated := data.get(self.outcome.terminated_key, None)) is not None:
            whole = whole | terminated[..., 0]
        for key in MASK_KEYS:  # padded rows may say anything
            if (mask := data.get(key, None)) is not None:
                whole = whole & mask.reshape(whole.shape)
        if not whole.any():
            raise BMRLError(
                f"size is {size}, and the longest episode has {int(steps.max())} steps; valid: a "
                "size of at most that"
            )
        return data.set(self.action_key, torch.cat(parts, -1))[whole]
