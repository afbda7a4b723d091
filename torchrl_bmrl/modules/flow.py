"""Flow: a generator that moves noise to an action along a learned velocity."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import squared_error
from torchrl_bmrl.generators import ActionKeys, LatentGenerator
from torchrl_bmrl.modules.generator import BoundedModule, make_mlp, sized


class _EulerDecoder(BoundedModule):
    """The action at the end of a flow that starts at the latent."""

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        num_cells: Sequence[int],
        bounds: tuple[float | Tensor, float | Tensor],
        euler_steps: int,
    ) -> None:
        super().__init__(bounds)
        self.velocity = make_mlp(observation_dim + action_dim + 1, action_dim, num_cells)
        self.euler_steps = euler_steps

    def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
        point, step = latent, 1.0 / self.euler_steps
        for number in range(self.euler_steps):
            # Expanded: the network computes the part of the time once for all candidates.
            time = point.new_full((1,), number * step).expand(*point.shape[:-1], 1)
            point = point + step * self.velocity(observation, point, time)
        return self.scaled(point)


class ActionFlow(LatentGenerator):
    r"""Generator of actions: a flow from noise z to an action, by conditional flow matching.

    The velocity :math:`v` is trained on straight lines from noise to the data's actions,

    .. math:: \lVert v(s, x_t, t) - (x_1 - x_0) \rVert^2 / |a|,\quad
              x_t = (1 - t)\, x_0 + t\, x_1,\quad x_0 \sim N(0, I),\quad t \sim U(0, 1),

    with :math:`x_1` the action, scaled to [-1, 1]. The action of a latent z is :math:`x_1` after
    ``euler_steps`` Euler steps from :math:`x_0 = z`, clamped to the bounds.

    Reference: Lipman et al., *Flow Matching for Generative Modeling*, ICLR 2023,
    https://arxiv.org/abs/2210.02747.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action, and of z.

    Keyword Args:
        euler_steps: steps from noise to action, each one call of the network.
        num_cells: widths of the hidden layers.
        bounds: lower and upper bound of the action, numbers or ``(action_dim,)``.
        observation_key: key of the observation.

    Reads ``observation (*B, observation_dim)``; ``decoder`` also reads ``action_latent
    (*B, action_dim)`` and writes ``action (*B, action_dim)``.

    Raises:
        BMRLError: for ``euler_steps`` below one.

    Example:
        >>> from tensordict import TensorDict
        >>> generator = ActionFlow(observation_dim=3, action_dim=2)
        >>> state = TensorDict({"observation": torch.zeros(5, 3)}, [5])
        >>> generator.propose(state, 4, ActionKeys())["action"].shape
        torch.Size([5, 4, 2])
    """

    metrics = ("velocity_error",)

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        euler_steps: int = 8,
        num_cells: Sequence[int] = (256, 256),
        bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
        observation_key: NestedKey = "observation",
    ) -> None:
        if euler_steps < 1:
            raise BMRLError(f"euler_steps is {euler_steps}; valid: at least 1")
        network = _EulerDecoder(observation_dim, action_dim, num_cells, bounds, euler_steps)
        reads = {observation_key: observation_dim, "action_latent": action_dim}
        super().__init__(sized(network, reads, {"action": action_dim}), action_dim)
        self.in_keys = [observation_key]

    def row_loss(
        self, tensordict: TensorDictBase, keys: ActionKeys
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared error of the velocity at a random time, for each row.

        Args:
            tensordict: observation and action, batch ``[*B]``.
            keys: names of the entries.

        Returns:
            the loss ``(*B,)``, and the same as ``velocity_error``.
        """
        network = self.decoder.module
        action = network.unscaled(tensordict.get(keys.action))
        noise, time = torch.randn_like(action), torch.rand_like(action[..., :1])
        point = (1.0 - time) * noise + time * action
        velocity = network.velocity(tensordict.get(self.in_keys[0]), point, time)
        error = squared_error(velocity, action - noise) / action.shape[-1]
        return error, {"velocity_error": error}
