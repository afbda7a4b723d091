"""Mixture density network: a generator that costs one call of its network for all candidates."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import ActionKeys, LatentGenerator
from torchrl_bmrl.modules.generator import BoundedModule, make_mlp, sized


class _MixtureDecoder(BoundedModule):
    """The action of a latent: its first number chooses the component, the others the point."""

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        num_cells: Sequence[int],
        bounds: tuple[float | Tensor, float | Tensor],
        num_components: int,
        min_scale: float,
    ) -> None:
        super().__init__(bounds)
        self.action_dim, self.num_components = action_dim, num_components
        self.min_scale = min_scale
        size = num_components * (2 * action_dim + 1)
        self.network = make_mlp(observation_dim, size, num_cells)

    def components(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logarithm of the weights ``(*B, K)``, means and deviations ``(*B, K, action_dim)``."""
        out = self.network(observation)
        logits, rest = out[..., : self.num_components], out[..., self.num_components :]
        loc, scale = rest.unflatten(-1, (self.num_components, -1)).chunk(2, -1)
        return logits.log_softmax(-1), loc, F.softplus(scale) + self.min_scale

    def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
        if observation.ndim > 1 and observation.stride(-2) == 0:
            observation = observation[..., :1, :]  # the same for all candidates
        log_weight, loc, scale = self.components(observation)
        share = torch.special.ndtr(latent[..., :1])  # uniform
        chosen = (log_weight.exp().cumsum(-1) < share).sum(-1).clamp(max=self.num_components - 1)
        chosen = F.one_hot(chosen, self.num_components).to(loc).unsqueeze(-1)
        loc, scale = ((x * chosen).sum(-2) for x in (loc, scale))
        return self.scaled(loc + scale * latent[..., 1:])


class ActionMixture(LatentGenerator):
    r"""Generator of actions: a mixture of Gaussians whose parameters depend on the state.

    Its loss is the negative log-likelihood of the data's action, scaled to [-1, 1],

    .. math:: -\frac{1}{|a|} \log \sum_k w_k(s)\, N(a;\ \mu_k(s),\ \sigma_k(s)^2)

    with :math:`\sigma_k \ge` ``min_scale``, since the likelihood of actions at a bound would have
    no maximum. Of a latent z, the first number chooses the component (by its share of the normal
    distribution), and the others are the deviation from its mean. The action is clamped to the
    bounds. All candidates of a state need only one call of the network.

    Reference: Bishop, *Mixture Density Networks*, 1994,
    https://publications.aston.ac.uk/id/eprint/373/.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action; z has one number more.

    Keyword Args:
        num_components: number of Gaussians.
        min_scale: smallest standard deviation, in units of half the action's range.
        num_cells: widths of the hidden layers.
        bounds: lower and upper bound of the action, numbers or ``(action_dim,)``.
        observation_key: key of the observation.

    Reads ``observation (*B, observation_dim)``; ``decoder`` also reads ``action_latent
    (*B, action_dim + 1)`` and writes ``action (*B, action_dim)``.

    Raises:
        BMRLError: for fewer than one component, or ``min_scale`` of 0.

    Example:
        >>> from tensordict import TensorDict
        >>> generator = ActionMixture(observation_dim=3, action_dim=2)
        >>> state = TensorDict({"observation": torch.zeros(5, 3)}, [5])
        >>> generator.propose(state, 4, ActionKeys())["action"].shape
        torch.Size([5, 4, 2])
    """

    metrics = ("negative_log_likelihood",)

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        num_components: int = 5,
        min_scale: float = 0.05,
        num_cells: Sequence[int] = (256, 256),
        bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
        observation_key: NestedKey = "observation",
    ) -> None:
        if num_components < 1:
            raise BMRLError(f"num_components is {num_components}; valid: at least 1")
        if not min_scale > 0:
            raise BMRLError(f"min_scale is {min_scale}; valid: above 0")
        network = _MixtureDecoder(
            observation_dim, action_dim, num_cells, bounds, num_components, min_scale
        )
        reads = {observation_key: observation_dim, "action_latent": action_dim + 1}
        super().__init__(sized(network, reads, {"action": action_dim}), action_dim + 1)
        self.in_keys = [observation_key]

    def row_loss(
        self, tensordict: TensorDictBase, keys: ActionKeys
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log-likelihood of the action per dimension, in nats, for each row.

        Args:
            tensordict: observation and action, batch ``[*B]``.
            keys: names of the entries.

        Returns:
            the loss ``(*B,)``, and the same as ``negative_log_likelihood``.
        """
        network = self.decoder.module
        action = network.unscaled(tensordict.get(keys.action)).unsqueeze(-2)
        log_weight, loc, scale = network.components(tensordict.get(self.in_keys[0]))
        log_density = -0.5 * ((action - loc) / scale).square() - scale.log()
        log_density = log_density.sum(-1) - 0.5 * action.shape[-1] * math.log(2.0 * math.pi)
        loss = -(log_weight + log_density).logsumexp(-1) / action.shape[-1]
        return loss, {"negative_log_likelihood": loss}
