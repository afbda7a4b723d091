"""A policy that plays chunks of actions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from torchrl_bmrl.errors import BMRLError

CHUNK, STEP = "action_chunk", "action_chunk_step"
"""Entries for the next step: the chunk, and how many of its actions were played."""


class ChunkPolicy(TensorDictModuleBase):
    """Plays the actions of a chunk one after the other, then asks its policy for the next chunk.

    The rest of the chunk travels with the data: TorchRL's rollouts and collectors pass what a
    policy writes on to the next step. A chunk also ends where ``is_init`` is true, which
    ``torchrl.envs.InitTracker`` writes: append it to environments that reset by themselves.

    ``torchrl.modules.MultiStepActorWrapper`` (0.14.1) asks its policy only at resets unless it gets
    ``n_steps``. ``torchrl.envs.MultiAction`` loses the reward of an episode that ends inside a
    chunk, or repeats it.

    Args:
        policy: writes chunks: ``size`` actions one after the other in the last dimension.
        size: number of actions in a chunk.

    Keyword Args:
        action_key: name of the action.

    Keys read: those of the policy, and ``is_init`` if the data have it. Keys written: ``action
    (*B, action_dim)``, and for the next step ``action_chunk (*B, size, action_dim)`` and
    ``action_chunk_step (*B, 1)``, the number of its actions that were played.

    Raises:
        BMRLError: for a size below one; and at a call if the policy does not write ``action_key``,
            or the size does not divide its action.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionFlow, BCQPolicy, make_qvalue_network
        >>> policy = ChunkPolicy(BCQPolicy(ActionFlow(3, 4 * 2), make_qvalue_network(3, 4 * 2)), 4)
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        size: int,
        *,
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        if size < 1:
            raise BMRLError(f"size is {size}; valid: at least 1")
        self.policy, self.size = policy, size
        self.action_key = action_key
        self.in_keys = list(policy.in_keys)
        self.out_keys = [action_key, CHUNK, STEP]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the next action of the chunk."""
        step, chunk = tensordict.get(STEP, None), tensordict.get(CHUNK, None)
        if step is None or chunk is None:
            chunk = self._next_chunk(tensordict)
            step = torch.zeros(*chunk.shape[:-2], 1, dtype=torch.int64, device=chunk.device)
        else:
            ended = step >= self.size
            if (first := tensordict.get("is_init", None)) is not None:
                ended = ended | first.reshape(ended.shape)
            if ended.any():
                chunk = torch.where(ended.unsqueeze(-1), self._next_chunk(tensordict), chunk)
                step = step.masked_fill(ended, 0)
        index = step.unsqueeze(-1).expand(*step.shape[:-1], 1, chunk.shape[-1])
        tensordict.set(self.action_key, chunk.gather(-2, index).squeeze(-2))
        return tensordict.set(CHUNK, chunk).set(STEP, step + 1)

    def _next_chunk(self, tensordict: TensorDictBase) -> torch.Tensor:
        """The policy's chunk for the present state, ``(*B, size, action_dim)``."""
        actions = self.policy(tensordict.select(*self.in_keys)).get(self.action_key, None)
        if actions is None:
            raise BMRLError(
                f"the policy writes {list(self.policy.out_keys)}, not {self.action_key!r}; valid: "
                "action_key of the policy's action"
            )
        if actions.shape[-1] % self.size:
            raise BMRLError(
                f"the policy writes {self.action_key!r} with {actions.shape[-1]} numbers; valid: a "
                f"multiple of size, {self.size}"
            )
        return actions.unflatten(-1, (self.size, -1))
