"""Policy in the Latent Action Space as a TorchRL loss module."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import soft_clipped_value
from torchrl_bmrl.objectives.checks import check_network, output
from torchrl_bmrl.objectives.generative import GenerativeLoss


class PLASLoss(GenerativeLoss):
    r"""Policy in the Latent Action Space.

    A deterministic policy :math:`\pi` chooses the latent of a conditional variational autoencoder
    :math:`G` of the data's actions, so whatever it chooses decodes into an action that the data
    support.

    Reference: Zhou et al., *PLAS: Latent Action Space for Offline Reinforcement Learning*, CoRL
    2020, https://arxiv.org/abs/2011.07213, algorithm 1.

    Losses, in update order:

    1. :meth:`generator_loss`:
       :math:`\lVert G(s, z) - a \rVert^2 / |a| + \beta\, \mathrm{KL}(q(z|s,a)\,\|\,N(0, I)) / |z|`
    2. :meth:`qvalue_loss`: :math:`\sum_j (Q_j(s, a) - y)^2` with
       :math:`y = r + \gamma (1 - \mathrm{terminated})
       [\lambda \min_j Q'_j(s', a') + (1 - \lambda) \max_j Q'_j(s', a')]`, where
       :math:`a' = G(s', \pi'(s'))`
    3. :meth:`actor_loss`: :math:`-Q_1(s, G(s, \pi(s)))`

    With a ``perturbation_network`` every decoded action :math:`a` becomes
    :math:`a + \phi\, h\, \xi(s, a)`, and the actor's loss trains :math:`\xi` too.

    As published, the generator is trained first, alone, and then held: call :meth:`generator_loss`
    for a while, and then the two others. The policy and the critics have targets, the generator
    has none.

    Args:
        generator: as for :class:`~torchrl_bmrl.objectives.BCQLoss`.
        actor_network: π (observation → ``action_latent``), bounded to where the generator was
            trained, such as :func:`torchrl_bmrl.modules.make_latent_actor`.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            an initialisation of its own, or one critic, of which ``num_qvalue_nets`` are made.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        num_qvalue_nets: number of critics; default 2 from a single one, else the list's length.
        lmbda: λ, weight of the critics' minimum against their maximum. Default 0.75.
        kl_weight: β. Default 0.5, as published.
        kl_reduction: whether the divergence is the ``"mean"`` (as published) or the ``"sum"``
            over the latent's dimensions.
        max_perturbation: φ, a share of half the action's range, in each dimension. Default 0.05.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"`` (Huber) between value and target.
        gamma: discount of the default TD(0) estimator. Default 0.99.
        separate_losses: parameters that another network shares with the generator are trained by
            the generator's loss alone.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; ``None`` is ``"mean"``.
        deactivate_vmap: run the critics in a loop and not under :func:`torch.vmap`.
        use_prioritized_weights: ``True``, ``False`` or ``"auto"``, as in TorchRL's losses.

    Keys read: ``observation (*B, obs_dim)``, ``action (*B, action_dim)``, and under ``"next"``
    ``observation``, ``reward``, ``done``, ``terminated``, each of the last three ``(*B, 1)``.
    Key written to the input: ``td_error (*B,)``, the priority.

    Raises:
        BMRLError: as :class:`~torchrl_bmrl.objectives.BCQLoss`.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_latent_actor, make_qvalue_network
        >>> generator = ActionVAE(observation_dim=3, action_dim=2)
        >>> actor = make_latent_actor(observation_dim=3, latent_dim=generator.latent_dim)
        >>> loss = PLASLoss(generator, actor, make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
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
        >>> (losses["loss_qvalue"] + losses["loss_actor"]).backward()
    """

    state_networks = ("actor_network", "qvalue_network", "perturbation_network")

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    _schedulable_buffers = frozenset({"lmbda"})

    def __init__(
        self,
        generator: TensorDictModule,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        perturbation_network: TensorDictModule | None = None,
        *,
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        num_qvalue_nets: int | None = None,
        lmbda: float = 0.75,
        kl_weight: float = 0.5,
        kl_reduction: str = "mean",
        max_perturbation: float = 0.05,
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
            max_perturbation=max_perturbation,
            loss_function=loss_function,
            gamma=gamma,
            separate_losses=separate_losses,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
        )
        for method in ("decode", "latent_dim"):
            if not hasattr(self.generator, method):
                raise BMRLError(
                    f"generator {type(self.generator).__name__} has no {method!r}; valid: one with "
                    "a latent for the policy to choose, such as torchrl_bmrl.modules.ActionVAE"
                )
        self.register_coefficients(high=1.0, lmbda=lmbda)
        check_network("actor_network", actor_network)
        self.check_sizes("actor_network", actor_network)
        self.convert_to_functional(actor_network, "actor_network", create_target_params=True)
        self.convert_critics(qvalue_network, num_qvalue_nets)
        self.finish()

    def written_keys(self) -> list[str]:
        """Losses in update order, then metrics."""
        return [
            "loss_generator",
            "loss_qvalue",
            "loss_actor",
            *self.generator_metrics,
            "pred_value",
            "target_value",
            "next_state_value",
        ]

    # -- losses, in update order; generator_loss is the base's -----------------------------------

    def act(self, observation: TensorDictBase, *, target: bool = False) -> TensorDictBase:
        """The observation with the policy's action.

        Args:
            observation: what policy and decoder read, batch ``[*B]``.
            target: whether the action is the target policy's.
        """
        acted = self.call("actor_network", observation.copy(), target=target)
        latent = output(acted, self.tensor_keys.action_latent, self.actor_network)
        decoded = self.decode(observation, latent)
        return self.perturb(decoded, target=target)

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Critics' loss, summed over the critics; gradients reach the critics alone.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        with torch.no_grad():
            after = self.rows(tensordict, self.observation_keys, after=True)
            after = self.act(after, target=True)
            value = self.qvalue(after, target=True)
            next_value = soft_clipped_value(value, self.lmbda)
        data = self.rows(tensordict, self.qvalue_network.in_keys)
        predicted = self.qvalue(data)
        result = self.temporal_difference(tensordict, predicted, next_value)
        self._clear_weakrefs(
            tensordict,
            data,
            "generator_params",
            "target_actor_network_params",
            "qvalue_network_params",
            "target_qvalue_network_params",
        )
        return result

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """-Q of the first critic at the policy's action; trains policy and perturbation alone.

        Returns:
            the loss, and no metrics.
        """
        acted = self.act(self.rows(tensordict, self.observation_keys))
        value = self.qvalue(acted, frozen=True)[0]
        loss = self.reduce(-value, tensordict)
        self._clear_weakrefs(tensordict, acted, "generator_params", "actor_network_params")
        return loss, {}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes every loss with the present parameters; see the class for keys."""
        loss_generator, generator_info = self.generator_loss(tensordict)
        loss_qvalue, qvalue_info = self.qvalue_loss(tensordict)
        tensordict.set(self.tensor_keys.priority, qvalue_info.pop("td_error").amax(0))
        loss_actor, _ = self.actor_loss(tensordict)
        losses = {
            "loss_generator": loss_generator,
            "loss_qvalue": loss_qvalue,
            "loss_actor": loss_actor,
        }
        return TensorDict(losses | generator_info | qvalue_info)
