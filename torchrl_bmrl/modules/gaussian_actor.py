"""Actor whose action is a Gaussian's, squashed between bounds."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.modules.generator import BoundedModule, make_mlp, sized

LOG_SCALE = (-20.0, 0.0)
"""Bounds of the logarithm of the Gaussian's scale, as in FOCAL's code."""


class _TanhGaussian(BoundedModule):
    def __init__(
        self,
        in_features: int,
        action_dim: int,
        num_cells: Sequence[int],
        bounds: tuple[float | Tensor, float | Tensor],
    ) -> None:
        super().__init__(bounds)
        self.network = make_mlp(in_features, 2 * action_dim, num_cells)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        loc, log_scale = self.network(*inputs).chunk(2, -1)
        return loc, log_scale.clamp(*LOG_SCALE).exp(), self.scaled(loc.tanh())


def make_gaussian_actor(
    observation_dim: int,
    action_dim: int,
    *,
    task_latent_dim: int = 0,
    num_cells: Sequence[int] = (256, 256),
    bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
) -> TensorDictModule:
    """Actor from observation and, with ``task_latent_dim``, ``task_latent``.

    Writes ``loc`` and ``scale`` of the Gaussian before it is squashed, ``(*B, action_dim)``, from
    which a loss samples, and ``action (*B, action_dim)``, the squashed ``loc``: the policy without
    its noise. TorchRL's ``ProbabilisticActor`` with ``TanhNormal`` makes a policy that samples.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        task_latent_dim: size of ``task_latent``; 0 for an actor without this input.
        num_cells: widths of the hidden layers.
        bounds: lower and upper bound of the action, numbers or ``(action_dim,)``.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import ProbabilisticActor, TanhNormal
        >>> actor = make_gaussian_actor(3, 2, task_latent_dim=4)
        >>> sampling = ProbabilisticActor(
        ...     actor.select_out_keys("loc", "scale"),
        ...     ["loc", "scale"],
        ...     distribution_class=TanhNormal,
        ... )
        >>> state = {"observation": torch.zeros(5, 3), "task_latent": torch.zeros(5, 4)}
        >>> sampling(TensorDict(state, [5]))["action"].shape
        torch.Size([5, 2])
    """
    reads = {"observation": observation_dim}
    if task_latent_dim:
        reads["task_latent"] = task_latent_dim
    network = _TanhGaussian(sum(reads.values()), action_dim, num_cells, bounds)
    return sized(network, reads, {"loc": action_dim, "scale": action_dim, "action": action_dim})
