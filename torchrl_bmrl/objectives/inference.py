"""Learns to tell the task from any behaviour: from a context to the m of its demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.context_keys import MASK
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import average, nonzero_scale, unpadded
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.base import KeyedLoss
from torchrl_bmrl.objectives.checks import check_network
from torchrl_bmrl.objectives.context_rows import context_keys
from torchrl_bmrl.objectives.data import check_same_shape, select


class ContextInferenceLoss(KeyedLoss):
    r"""Fits an encoder of contexts of any behaviour to the point m of each task.

    .. math:: \lVert I(c) - m_i \rVert_2^2 / \sigma^2

    An encoder that is distilled with demonstrations reads the task from the demonstrator's
    actions. In an episode of a policy that does not know the task, only rewards and motion tell
    it. This loss trains a second encoder I on contexts c of task i, of demonstrations and of other
    behaviour alike, towards the points that the distilled policy listens to. σ is the root mean
    square distance of the points from their mean. The points are constants.

    Args:
        context_encoder: I, :func:`torchrl_bmrl.modules.make_context_encoder`'s module.
        task_latents: m_i, ``(num_tasks, m)``, such as a student's prototypes.

    Keyword Args:
        **options: of :class:`~torchrl_bmrl.objectives.KeyedLoss`.

    Keys read, batch ``[num_tasks, C]``: those of the encoder, C contexts of each task. Key written
    to the input: ``td_error (num_tasks, C)``, the priority: a context's error.

    Raises:
        BMRLError: for an encoder of single transitions, or points of another shape; and at a call
            for data that do not fit.

    Example:
        >>> from torchrl_bmrl.modules import as_context, make_context_encoder
        >>> loss = ContextInferenceLoss(make_context_encoder(3, 2, 8), torch.randn(4, 8))
        >>> data = {"observation": torch.randn(4, 5, 9, 3), "action": torch.randn(4, 5, 9, 2)}
        >>> after = {"observation": torch.randn(4, 5, 9, 3), "reward": torch.randn(4, 5, 9, 1)}
        >>> contexts = as_context(TensorDict(data | {"next": after}, [4, 5, 9]))
        >>> loss(contexts)["loss_inference"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename."""

        task_latent: NestedKey = "task_latent"  # the encoder's output
        priority: NestedKey = "td_error"  # written to the input
        priority_weight: NestedKey = "priority_weight"  # read from the input where present

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    task_latents: Tensor
    context_encoder: TensorDictModule
    context_encoder_params: TensorDictParams
    target_context_encoder_params: TensorDictParams

    def __init__(
        self,
        context_encoder: TensorDictModule,
        task_latents: Tensor | Sequence[Sequence[float]],
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_network("context_encoder", context_encoder)
        context_keys(context_encoder)
        points = torch.as_tensor(task_latents).detach().clone()
        if points.ndim != 2:
            raise BMRLError(
                f"task_latents is of shape {tuple(points.shape)}; valid: (num_tasks, m)"
            )
        self.convert_to_functional(context_encoder, "context_encoder", create_target_params=False)
        spread = (points - points.mean(0)).square().sum(-1).mean()
        self.register_buffer("task_latents", points)
        self.register_buffer("scale", nonzero_scale(spread, points.abs().max(), points.dtype))
        self.keep_keys()

    def read_keys(self) -> list[NestedKey]:
        """What the encoder reads."""
        return list(self.context_encoder.in_keys)

    def written_keys(self) -> list[str]:
        """The loss, then the share of contexts whose nearest point is that of their task."""
        return ["loss_inference", "accuracy"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss; the class lists the keys.

        Raises:
            BMRLError: for data that do not fit.
        """
        self.check_names()
        batch = tensordict.batch_size
        if len(batch) != 2 or batch[0] != len(self.task_latents):
            raise BMRLError(
                f"the data's batch size is {list(batch)}; valid: [{len(self.task_latents)}, C], C "
                "contexts of each task"
            )
        valid = self.valid_rows(tensordict, batch)
        data = self.call("context_encoder", self._contexts(tensordict, valid))
        points = written(data, self.tensor_keys.task_latent, self.context_encoder)
        target = self.task_latents.unsqueeze(1)
        check_same_shape(self.tensor_keys.task_latent, target.expand(*batch, -1), points)
        error = (points - target).square().sum(-1) / self.scale
        priority = unpadded(error.detach(), valid)
        tensordict.set(self.tensor_keys.priority, priority)
        nearest = torch.cdist(points.detach().flatten(0, 1), self.task_latents).argmin(-1)
        own = torch.arange(len(self.task_latents), device=points.device).unsqueeze(-1)
        right = (nearest.view(batch) == own).to(points.dtype)
        losses = {"loss_inference": self.reduce(error, tensordict)}
        return TensorDict(losses | {"accuracy": average(right, valid)})

    def _contexts(self, tensordict: TensorDictBase, valid: Tensor | None) -> TensorDictBase:
        """What the encoder reads; contexts that do not count are full of zeros."""
        batch = tensordict.batch_size
        if valid is None:
            return tensordict.select(*self.in_keys)
        contexts = select(tensordict, self.in_keys, batch, valid, readers=self.readers)
        present = contexts.get(MASK)
        return contexts.set(MASK, present | ~valid.unsqueeze(-1))
