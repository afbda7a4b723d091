"""Batch-Constrained Q-learning as a TorchRL loss module."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import bcq_next_value
from torchrl_bmrl.objectives.checks import check_number, check_value_bounds
from torchrl_bmrl.objectives.generative import GenerativeLoss

TARGET_DTYPES = ("bfloat16",)


class BCQLoss(GenerativeLoss):
    r"""Batch-Constrained deep Q-learning.

    A generator :math:`G`, as published a conditional variational autoencoder, learns which actions
    the data hold; the critics :math:`Q_j` bootstrap only from actions that :math:`G` proposes.

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

    :meth:`forward` computes all of them with the present parameters; a loop that follows the
    published order calls the three methods one after the other and steps each optimizer between.
    There is no target generator. Targets move only under
    :class:`~torchrl.objectives.SoftUpdate` or :class:`~torchrl.objectives.HardUpdate`.

    Args:
        generator: what models the data's actions, such as :class:`torchrl_bmrl.modules.ActionVAE`,
            or any generator as :mod:`torchrl_bmrl.generators` describes it.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            an initialisation of its own, or one critic, of which ``num_qvalue_nets`` are made.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        num_qvalue_nets: number of critics; default 2 from a single one, else the list's length.
        num_candidates: actions proposed per next state. Default 10.
        lmbda: λ, weight of the critics' minimum against their maximum. Default 0.75.
        latent_clip: bound on the latent of proposed actions; ``None`` turns it off. Default 0.5.
        kl_weight: β. Default 0.5, as published.
        kl_reduction: whether the divergence is the ``"mean"`` (as published) or the ``"sum"``
            over the latent's dimensions.
        max_perturbation: φ, a share of half the action's range, in each dimension. Default 0.05.
        value_bounds: ``(low, high)`` that the next states' value is clamped to; ``None`` for none.
            With rewards in [0, 1], (0, 1 / (1 - γ)) holds back a critic that runs away.
        target_dtype: ``"bfloat16"`` proposes and values the next states' actions in that type
            (autocast); ``None``, the default, in the networks' own. Faster only where the processor
            multiplies it faster, see docs/performance.md.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"`` (Huber) between value and target.
        gamma: discount of the default TD(0) estimator. Default 0.99.
        separate_losses: parameters that critics or perturbation network share with the generator
            are trained by the generator's loss alone.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; ``None`` is ``"mean"``.
        deactivate_vmap: run the critics in a loop and not under :func:`torch.vmap`.
        use_prioritized_weights: ``True``, ``False`` or ``"auto"``, as in TorchRL's losses.

    Keys read: ``observation (*B, obs_dim)``, ``action (*B, action_dim)``, and under ``"next"``
    ``observation``, ``reward``, ``done``, ``terminated``, each of the last three ``(*B, 1)``.
    Key written to the input: ``td_error (*B,)``, the priority.

    Raises:
        BMRLError: for candidates below one, λ outside [0, 1], a generator that lacks a part,
            bounds that are not the generator's, networks of different sizes, no critics, an
            unknown ``loss_function``, ``reduction``, ``kl_reduction`` or ``target_dtype``, bounds
            in the wrong order, or bounds and spec given together or not at all; and at a call for
            data with missing keys, other shapes or, on CPU and not compiled, numbers that are not
            finite or actions outside the bounds.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> generator = ActionVAE(observation_dim=3, action_dim=2)
        >>> critics = [make_qvalue_network(observation_dim=3, action_dim=2) for _ in range(2)]
        >>> loss = BCQLoss(generator, critics, bounds=(-1.0, 1.0))
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 3),
        ...         "action": torch.rand(8, 2) * 2 - 1,
        ...         "next": {
        ...             "observation": torch.randn(8, 3),
        ...             "reward": torch.randn(8, 1),
        ...             "done": torch.zeros(8, 1, dtype=torch.bool),
        ...             "terminated": torch.zeros(8, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     batch_size=[8],
        ... )
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
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        num_qvalue_nets: int | None = None,
        num_candidates: int = 10,
        lmbda: float = 0.75,
        latent_clip: float | None = 0.5,
        kl_weight: float = 0.5,
        kl_reduction: str = "mean",
        max_perturbation: float = 0.05,
        value_bounds: tuple[float, float] | None = None,
        target_dtype: str | None = None,
        loss_function: str = "l2",
        gamma: float = 0.99,
        separate_losses: bool = False,
        reduction: str | None = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__(
            generator,
            perturbation_network,
            action_spec=action_spec,
            bounds=bounds,
            kl_weight=kl_weight,
            kl_reduction=kl_reduction,
            latent_clip=latent_clip,
            max_perturbation=max_perturbation,
            loss_function=loss_function,
            gamma=gamma,
            separate_losses=separate_losses,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
        )
        self.num_candidates = check_number("num_candidates", num_candidates, 1, integer=True)
        self.value_bounds = check_value_bounds(value_bounds)
        if target_dtype not in (None, *TARGET_DTYPES):
            raise UnknownNameError("target_dtype", target_dtype, (None, *TARGET_DTYPES))
        self.target_dtype = target_dtype
        self.register_coefficients(high=1.0, lmbda=lmbda)
        self.convert_critics(qvalue_network, num_qvalue_nets)
        self.finish()

    def written_keys(self) -> list[str]:
        """Losses in update order, then metrics."""
        return [
            "loss_generator",
            "loss_qvalue",
            *(["loss_perturbation"] if self.perturbation_network is not None else []),
            *self.generator_metrics,
            "pred_value",
            "target_value",
            "next_state_value",
        ]

    # -- losses, in update order; generator_loss is the base's -----------------------------------

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Critics' loss, summed over the critics; gradients reach the critics alone.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        with torch.no_grad():
            after = self.rows(tensordict, self.observation_keys, after=True)
            with self._target_precision():
                proposals = self.propose(after, self.num_candidates)
                proposals = self.perturb(proposals, target=True)
                candidates = self.qvalue(proposals, target=True)
            next_value = bcq_next_value(candidates.to(self.lmbda.dtype), self.lmbda)
            if self.value_bounds is not None:
                next_value = next_value.clamp(*self.value_bounds)
        data = self.rows(tensordict, self.qvalue_network.in_keys)
        predicted = self.qvalue(data)
        result = self.temporal_difference(tensordict, predicted, next_value)
        self._clear_weakrefs(
            tensordict,
            data,
            "generator_params",
            "qvalue_network_params",
            "target_qvalue_network_params",
        )
        return result

    def _target_precision(self) -> AbstractContextManager[None]:
        if self.target_dtype is None:
            return nullcontext()
        return torch.autocast(self.lmbda.device.type, getattr(torch, self.target_dtype))

    def perturbation_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Perturbation network's loss, -Q of the first critic; gradients reach it alone.

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
        value = self.qvalue(proposal, frozen=True)[0]
        loss = self.reduce(-value, tensordict)
        self._clear_weakrefs(tensordict, proposal, "perturbation_network_params")
        return loss, {}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes every loss with the present parameters; see the class for keys."""
        loss_generator, generator_info = self.generator_loss(tensordict)
        loss_qvalue, qvalue_info = self.qvalue_loss(tensordict)
        tensordict.set(self.tensor_keys.priority, qvalue_info.pop("td_error").amax(0))
        losses = {"loss_generator": loss_generator, "loss_qvalue": loss_qvalue}
        if self.perturbation_network is not None:
            losses["loss_perturbation"], _ = self.perturbation_loss(tensordict)
        return TensorDict(losses | generator_info | qvalue_info)
