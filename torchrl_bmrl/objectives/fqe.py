"""Fitted Q evaluation as a TorchRL loss module."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import set_exploration_type

from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.checks import check_network
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.data import entry, next_key
from torchrl_bmrl.objectives.ensemble import kind


class FQELoss(OfflineLoss):
    r"""Fitted Q evaluation: estimates a policy's return from a fixed batch.

    It learns critics :math:`Q_j` of a policy :math:`\pi` that does not change. Their estimates rank
    policies, such as the checkpoints of a training run, without a simulator.

    Reference: Le, Voloshin and Yue, *Batch Policy Learning under Constraints*, ICML 2019,
    https://arxiv.org/abs/1903.08738, algorithm 3.

    .. math::
        L = \sum_j (Q_j(s, a) - y)^2,\quad y = r + \gamma\, (1 - \mathrm{terminated})\,
        \frac{1}{n} \sum_j Q'_j(s', \pi(s'))

    The published algorithm fits one critic to convergence before its target moves. Here the target
    moves under :class:`~torchrl.objectives.HardUpdate`, which does the same at a long interval, or
    :class:`~torchrl.objectives.SoftUpdate`. :meth:`policy_value` returns the estimate.

    The policy is copied, in evaluation mode: it receives no gradient, no optimizer finds it, and
    later updates of the original do not reach the copy. ``state_dict()`` contains it under
    ``policy_params``. A policy that draws, such as :class:`~torchrl_bmrl.modules.BCQPolicy`, draws
    anew at every call. A probabilistic module of TorchRL acts by its mode, as in every loss, unless
    ``deterministic_sampling_mode`` is changed.

    Args:
        policy: any module that writes the action, such as
            :class:`~torchrl_bmrl.modules.BCQPolicy`, :class:`~torchrl_bmrl.modules.PLASPolicy` or
            :class:`~torchrl_bmrl.modules.DiscreteBCQPolicy`.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            its own initialisation, or one critic, which is copied ``num_qvalue_nets`` times. A
            critic of discrete actions reads them one-hot; one that writes the value of every action
            is not accepted.

    Keyword Args:
        num_qvalue_nets: number of critics; ``None``: 1 from a single critic, or the list's length.
        **options: of :class:`~torchrl_bmrl.objectives.OfflineLoss`, such as ``gamma`` and
            ``loss_function``. Without a generator ``separate_losses`` has no effect.

    Keys read: ``observation (*B, obs_dim)``, ``action (*B, action_dim)``, and under ``"next"``
    ``observation``, ``reward``, ``done``, ``terminated``, each of the last three ``(*B, 1)``.
    Key written to the input: ``td_error (*B,)``, the priority.

    Raises:
        BMRLError: for a policy that is no TensorDictModule, no critics, or an option that the base
            refuses; and at a call for a policy that writes no action, critics that write no
            ``state_action_value (*B, 1)``, and data with missing keys, other shapes or, on CPU and
            not compiled, numbers that are not finite.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, PLASPolicy, make_latent_actor
        >>> from torchrl_bmrl.modules import make_qvalue_network
        >>> policy = PLASPolicy(make_latent_actor(3, 4), ActionVAE(3, 2).decoder)
        >>> loss = FQELoss(policy, make_qvalue_network(3, 2), gamma=0.9)
        >>> flag = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.randn(8, 3), "reward": torch.randn(8, 1)}
        >>> after |= {"done": flag, "terminated": flag}
        >>> data = {"observation": torch.randn(8, 3), "action": torch.rand(8, 2) * 2 - 1}
        >>> data = TensorDict(data | {"next": after}, batch_size=[8])
        >>> loss(data)["loss_qvalue"].backward()
        >>> loss.policy_value(data[:2].select("observation")).shape
        torch.Size([])
    """

    terms = ("qvalue",)
    frozen_networks = ("policy",)

    policy: TensorDictModuleBase
    policy_params: TensorDictParams

    def __init__(
        self,
        policy: TensorDictModuleBase,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        num_qvalue_nets: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_network("policy", policy)
        policy = deepcopy(policy).eval()
        params = TensorDict.from_module(policy)
        # The loss holds the parameters, as buffers; the module keeps only their places.
        self.policy_params = TensorDictParams(params.data, no_convert=True)
        meta = params.apply(self._make_meta_params, device=torch.device("meta"), filter_empty=False)
        meta.to_module(policy)
        self.__dict__["policy"] = policy
        self.policy_kind = kind(policy)  # a StackedLoss compares it between members
        self.convert_critics(qvalue_network, num_qvalue_nets, default=1)
        self.finish()

    @property
    def observation_keys(self) -> list[NestedKey]:
        """What policy and critics read of a state."""
        keys = dict.fromkeys([*self.policy.in_keys, *self.qvalue_network.in_keys])
        return [key for key in keys if key != self.tensor_keys.action]

    def read_keys(self) -> Iterable[NestedKey]:
        """What the critics read, the action, and what followed."""
        now = [*self.qvalue_network.in_keys, self.tensor_keys.action]
        return [*now, *map(next_key, self.observation_keys), *self.outcome_keys]

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them; only the critics receive gradients.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        with torch.no_grad():
            after = self.rows(tensordict, self.observation_keys, after=True)
            next_value = self.state_value(after, target=True)
        data = self.rows(tensordict, self.qvalue_network.in_keys)
        return self.temporal_difference(tensordict, self.qvalue(data), next_value)

    # -- value of the policy ---------------------------------------------------------------------

    def state_value(self, observation: TensorDictBase, *, target: bool = False) -> Tensor:
        r"""Value of states under the policy, :math:`\frac{1}{n} \sum_j Q_j(s, \pi(s))`, ``(*B,)``.

        Args:
            observation: what policy and critics read of a state, batch ``[*B]``.
            target: whether the targets' parameters are used.

        Raises:
            BMRLError: if the policy writes no action, or the state does not fit the networks.
        """
        data = self.call("policy", observation.copy(), frozen=True)
        written(data, self.tensor_keys.action, self.policy)
        return self.qvalue(data, target=target).mean(0)

    @torch.no_grad()
    def policy_value(self, tensordict: TensorDictBase) -> Tensor:
        r"""Estimate of the policy's discounted return, the mean value of start states, ``()``.

        .. math:: \hat J(\pi) = \mathbb{E}_{s_0} \frac{1}{n} \sum_j Q_j(s_0, \pi(s_0))

        Args:
            tensordict: start states, batch ``[*B]``, with what policy and critics read of a state.

        Returns:
            the estimate, without gradient, in the reward's unit. An episode that is truncated
            counts as if it went on.

        Raises:
            BMRLError: for missing keys, other shapes or, on CPU and not compiled, numbers that are
                not finite.
        """
        states = TensorDict({}, batch_size=tensordict.batch_size)
        for key in self.observation_keys:
            states.set(key, entry(tensordict, key))
        with set_exploration_type(self.deterministic_sampling_mode):
            return self.state_value(states).mean()
