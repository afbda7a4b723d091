"""ReBRAC as a TorchRL loss module."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_bmrl.functional import average, squared_error
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.checks import check_network
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.data import check_within, next_key
from torchrl_bmrl.objectives.generative import action_bounds, register_bounds


class ReBRACLoss(OfflineLoss):
    r"""ReBRAC: TD3 with penalties for actions that are far from the data's actions.

    Reference: Tarasov et al., *Revisiting the Minimalist Approach to Offline Reinforcement
    Learning*, NeurIPS 2023, https://arxiv.org/abs/2305.09836.

    Losses, in update order, where :math:`\hat a'` is the data's next action:

    1. :meth:`qvalue_loss`: :math:`\sum_j (Q_j(s, a) - y)^2` with
       :math:`y = r + \gamma (1 - \mathrm{terminated})
       [\min_j Q'_j(s', a') - \beta_2 \lVert a' - \hat a' \rVert^2]` and
       :math:`a' = \mathrm{clip}(\pi'(s') + h\, \mathrm{clip}(\epsilon, \pm c),
       a_{low}, a_{high})`, where :math:`\epsilon \sim N(0, \sigma^2)` and
       :math:`h = (a_{high} - a_{low}) / 2`
    2. :meth:`actor_loss`: :math:`\beta_1 \lVert \pi(s) - a \rVert^2 - \min_j Q_j(s, \pi(s)) / n`,
       where n is the mean of :math:`|\min_j Q_j(s, \pi(s))|` over the batch, without gradient

    As published, the critics have layer normalisation, and :meth:`actor_loss` is minimised and the
    targets are stepped only at every second update. The default penalties are where to start: the
    authors tune both for each data set. Their grid for MuJoCo and Adroit
    (https://github.com/DT6A/ReBRAC) is β₁ in 0.001, 0.01, 0.05, 0.1 and β₂ in 0, 0.001, 0.01, 0.1,
    0.5.

    Args:
        actor_network: π (observation → ``action`` within the bounds), deterministic.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            its own initialisation, or one critic, which is copied ``num_qvalue_nets`` times.

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        num_qvalue_nets: number of critics; ``None``: 2 from a single critic, or the list's length.
        actor_penalty: β₁.
        critic_penalty: β₂.
        normalise_q: whether the actor's value is divided by n; if not, n is 1.
        policy_noise: σ, a share of half the action's range.
        noise_clip: c, likewise.
        **options: of :class:`~torchrl_bmrl.objectives.OfflineLoss`.

    Keys read: the networks' inputs and ``action (*B, action_dim)``, both now and under ``"next"``,
    and ``("next", "reward")``, ``("next", "done")`` and ``("next", "terminated")``, ``(*B, 1)``.
    :func:`torchrl_bmrl.data.with_next_action` adds ``("next", "action")`` to demonstrations.

    Keys written: the losses and metrics of the output, and ``td_error (*B,)`` in the input.

    Raises:
        BMRLError: for negative coefficients, bounds and spec given together or not at all, networks
            whose sizes differ, missing keys, and on CPU at a call for actions outside the bounds.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP
        >>> from torchrl_bmrl.modules import make_qvalue_network
        >>> layers = torch.nn.Sequential(MLP(3, 2, num_cells=[8]), torch.nn.Tanh())
        >>> actor = TensorDictModule(layers, in_keys=["observation"], out_keys=["action"])
        >>> loss = ReBRACLoss(actor, make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> flag = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.randn(8, 3), "action": torch.rand(8, 2) * 2 - 1}
        >>> after |= {"reward": torch.randn(8, 1), "done": flag, "terminated": flag}
        >>> data = {"observation": torch.randn(8, 3), "action": torch.rand(8, 2) * 2 - 1}
        >>> losses = loss(TensorDict(data | {"next": after}, batch_size=[8]))
        >>> (losses["loss_qvalue"] + losses["loss_actor"]).backward()
    """

    terms = ("qvalue", "actor")
    _schedulable_buffers = frozenset(
        {"actor_penalty", "critic_penalty", "policy_noise", "noise_clip"}
    )

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        num_qvalue_nets: int | None = None,
        actor_penalty: float = 0.1,
        critic_penalty: float = 0.1,
        normalise_q: bool = True,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.normalise_q = normalise_q
        check_network("actor_network", actor_network)
        self.check_sizes("actor_network", actor_network)
        self.convert_to_functional(actor_network, "actor_network", create_target_params=True)
        self.register_coefficients(actor_penalty=actor_penalty, critic_penalty=critic_penalty)
        self.register_coefficients(policy_noise=policy_noise, noise_clip=noise_clip)
        register_bounds(self, *action_bounds(action_spec, bounds, self.tensor_keys.action))
        self.convert_critics(qvalue_network, num_qvalue_nets)
        self.finish()

    # -- keys ------------------------------------------------------------------------------------

    @property
    def observation_keys(self) -> list[NestedKey]:
        """Keys of the observation, which the networks read."""
        keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        return [key for key in dict.fromkeys(keys) if key != self.tensor_keys.action]

    def read_keys(self) -> Iterable[NestedKey]:
        """Observation and action, now and after the step, and the outcome."""
        now = [*self.observation_keys, self.tensor_keys.action]
        return [*now, *map(next_key, now), *self.outcome_keys]

    # -- losses, in update order -----------------------------------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them; only the critics receive gradients.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        key = self.tensor_keys.action
        with torch.no_grad():
            after = self.rows(tensordict, [*self.observation_keys, key], after=True)
            data_action = after.get(key)
            self._check_within(next_key(key), data_action, tensordict)
            action = self._act(after, target=True)
            noise = self.policy_noise * torch.randn_like(action)
            noise = noise.clamp(-self.noise_clip, self.noise_clip)
            action = action + 0.5 * (self.action_high - self.action_low) * noise
            action = action.clamp(self.action_low, self.action_high)
            value = self.qvalue(after.set(key, action), target=True).amin(0)
            next_value = value - self.critic_penalty * squared_error(action, data_action)
        predicted = self.qvalue(self.rows(tensordict, self.qvalue_network.in_keys))
        return self.temporal_difference(tensordict, predicted, next_value)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Penalty on the policy's action minus its value; only the actor receives gradients.

        Returns:
            the loss, and no metrics.
        """
        key = self.tensor_keys.action
        data = self.rows(tensordict, [*self.observation_keys, key])
        data_action = data.get(key)
        self._check_within(key, data_action, tensordict)
        action = self._act(data)
        value = self.qvalue(data.set(key, action), frozen=True).amin(0)
        penalty = self.actor_penalty * squared_error(action, data_action)
        if self.normalise_q:
            size = average(value.abs(), self.valid_rows(tensordict, value.shape))
            value = value / size.clamp(min=1e-6)  # no row may count
        return self.reduce(penalty - value, tensordict), {}

    def _act(self, observation: TensorDictBase, *, target: bool = False) -> Tensor:
        acted = self.call("actor_network", observation.copy(), target=target)
        return written(acted, self.tensor_keys.action, self.actor_network)

    def _check_within(self, key: NestedKey, action: Tensor, tensordict: TensorDictBase) -> None:
        valid = self.valid_rows(tensordict, action.shape[:-1])
        check_within(key, action, self.action_low, self.action_high, valid)
