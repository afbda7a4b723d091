"""Batch-Constrained Q-learning as a TorchRL loss module."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import (
    ACTING_RULES,
    TARGET_RULES,
    bcq_next_value,
    ensemble_value,
)
from torchrl_bmrl.objectives.checks import check_choice, check_number, check_value_bounds
from torchrl_bmrl.objectives.generative import GenerativeLoss


class BCQLoss(GenerativeLoss):
    r"""Batch-Constrained deep Q-learning.

    A generator :math:`G`, in the paper a conditional variational autoencoder, learns which actions
    the data contain. The critics :math:`Q_j` bootstrap only from actions that :math:`G` proposes.

    Reference: Fujimoto et al., *Off-Policy Deep Reinforcement Learning without Exploration*, ICML
    2019, https://arxiv.org/abs/1812.02900, algorithm 1.

    Losses, in update order:

    1. :meth:`generator_loss`, of an autoencoder:
       :math:`\lVert G(s, z) - a \rVert^2 / |a| + \beta\, \mathrm{KL}(q(z|s,a)\,\|\,N(0, I)) / |z|`
    2. :meth:`qvalue_loss`: :math:`\sum_j (Q_j(s, a) - y)^2` with
       :math:`y = r + \gamma (1 - \mathrm{terminated}) \max_i
       [\lambda \min_j Q'_j(s', a_i) + (1 - \lambda) \max_j Q'_j(s', a_i)]`, where
       :math:`a_i = G(s', z_i)`, :math:`z_i \sim N(0, I)` clipped to ± ``latent_clip``
    3. :meth:`perturbation_loss` (only with a ``perturbation_network``):
       :math:`-Q_1(s, a + \phi\, h\, \xi(s, a))` with :math:`a = G(s, z)` and :math:`h` half the
       action's range

    The generator decides which published method this is. All choose the best of N proposals, in the
    target and in the policy:

    - :class:`torchrl_bmrl.modules.ActionVAE` with a perturbation network: BCQ; without one, stage 1
      of this project's paper.
    - another model of the data's actions, without perturbation: EMaQ,
      https://arxiv.org/abs/2007.11091, whose N is larger when acting. Such models are
      :class:`torchrl_bmrl.modules.ActionMixture` and :class:`torchrl_bmrl.modules.ActionFlow`.
    - :class:`torchrl_bmrl.modules.ActionFlow`, few candidates, ``acting_rule="mean"`` or ``"min"``:
      best-of-N over a flow, as in Q-chunking, https://arxiv.org/abs/2507.07969, there with chunks
      of actions.

    :meth:`forward` computes all losses with the current parameters. To follow the published order,
    call the three methods one after the other and step each optimizer in between. The generator has
    no target. :class:`~torchrl.objectives.SoftUpdate` or :class:`~torchrl.objectives.HardUpdate`
    updates the other targets.

    Args:
        generator: model of the data's actions, such as :class:`torchrl_bmrl.modules.ActionVAE`, or
            any generator as :mod:`torchrl_bmrl.generators` describes it.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            its own initialisation, or one critic, which is copied ``num_qvalue_nets`` times.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        num_qvalue_nets: number of critics; ``None``: 2 from a single critic, or the list's length.
        num_candidates: actions proposed per next state.
        lmbda: λ, weight of the critics' minimum; the weight of their maximum is 1 - λ.
        target_rule: how the critics value the next state's actions: ``"clipped"``, by λ as above
            (1 is the minimum), or ``"mean"``, by their mean.
        acting_rule: how critics value actions in the policy and in the perturbation's loss: by the
            ``"first"`` critic as above, or by the ``"mean"`` or the ``"min"`` over all.
        latent_clip: bound on the latent of proposed actions; ``None`` for none.
        value_bounds: ``(low, high)`` that the next states' value is clamped to; ``None`` for none.
            With rewards in [0, 1], (0, 1 / (1 - γ)) keeps a critic from diverging.
        **options: of :class:`~torchrl_bmrl.objectives.GenerativeLoss`: ``action_spec`` or
            ``bounds``, ``kl_weight`` (β), ``kl_reduction``, ``max_perturbation`` (φ); and of
            :class:`~torchrl_bmrl.objectives.OfflineLoss`: ``gamma``, ``loss_function``,
            ``separate_losses``, ``reduction``, ``deactivate_vmap``, ``use_prioritized_weights``.

    Keys read: ``observation (*B, obs_dim)``, ``action (*B, action_dim)``, and under ``"next"``
    ``observation``, ``reward``, ``done``, ``terminated``, each of the last three ``(*B, 1)``.
    Key written to the input: ``td_error (*B,)``, the priority.

    Raises:
        BMRLError: for ``num_candidates`` below one, λ outside [0, 1], ``value_bounds`` in the wrong
            order, no critics, or an option that a base refuses; and at a call for data with missing
            keys, other shapes or, on CPU and not compiled, numbers that are not finite or actions
            outside the bounds.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> generator = ActionVAE(observation_dim=3, action_dim=2)
        >>> critics = [make_qvalue_network(observation_dim=3, action_dim=2) for _ in range(2)]
        >>> loss = BCQLoss(generator, critics, bounds=(-1.0, 1.0))
        >>> flag = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.randn(8, 3), "reward": torch.randn(8, 1)}
        >>> after |= {"done": flag, "terminated": flag}
        >>> data = {"observation": torch.randn(8, 3), "action": torch.rand(8, 2) * 2 - 1}
        >>> data = TensorDict(data | {"next": after}, batch_size=[8])
        >>> losses = loss(data)
        >>> (losses["loss_generator"] + losses["loss_qvalue"]).backward()
    """

    _schedulable_buffers = frozenset({"lmbda"})

    def __init__(
        self,
        generator: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        perturbation_network: TensorDictModule | None = None,
        *,
        num_qvalue_nets: int | None = None,
        num_candidates: int = 10,
        lmbda: float = 0.75,
        target_rule: str = "clipped",
        acting_rule: str = "first",
        latent_clip: float | None = 0.5,
        value_bounds: tuple[float, float] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(generator, perturbation_network, latent_clip=latent_clip, **options)
        self.num_candidates = check_number("num_candidates", num_candidates, 1, integer=True)
        self.value_bounds = check_value_bounds(value_bounds)
        self.register_coefficients(high=1.0, lmbda=lmbda)
        self.target_rule = check_choice("target_rule", target_rule, TARGET_RULES)
        self.acting_rule = check_choice("acting_rule", acting_rule, ACTING_RULES)
        self.convert_critics(qvalue_network, num_qvalue_nets)
        self.finish()

    @property
    def terms(self) -> list[str]:
        """Names of the losses, in update order."""
        perturbed = self.perturbation_network is not None
        return ["generator", "qvalue", *(["perturbation"] if perturbed else [])]

    # -- losses, in update order; the base has generator_loss ------------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them; only the critics receive gradients.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        with torch.no_grad():
            after = self.rows(tensordict, self.observation_keys, after=True)
            proposals = self.perturb(self.propose(after, self.num_candidates), target=True)
            value = self.qvalue(proposals, target=True)
            if self.target_rule == "mean":
                next_value = ensemble_value(value, "mean").amax(-1)
            else:
                next_value = bcq_next_value(value, self.lmbda)
            if self.value_bounds is not None:
                next_value = next_value.clamp(*self.value_bounds)
        data = self.rows(tensordict, self.qvalue_network.in_keys)
        return self.temporal_difference(tensordict, self.qvalue(data), next_value)

    def perturbation_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the perturbation network, -Q by ``acting_rule``; only it receives gradients.

        Returns:
            the loss, and no metrics.

        Raises:
            BMRLError: if the loss was made without a perturbation network.
        """
        if self.perturbation_network is None:
            raise BMRLError("this BCQLoss was made without a perturbation_network")
        with torch.no_grad():
            observation = self.rows(tensordict, self.observation_keys)
            proposal = self.propose(observation, 1).squeeze(-1)
        proposal = self.perturb(proposal)
        value = ensemble_value(self.qvalue(proposal, frozen=True), self.acting_rule)
        return self.reduce(-value, tensordict), {}
