"""Policy in the Latent Action Space as a TorchRL loss module."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import soft_clipped_value
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.checks import check_network
from torchrl_bmrl.objectives.generative import GenerativeLoss


class PLASLoss(GenerativeLoss):
    r"""Policy in the Latent Action Space.

    A deterministic policy :math:`\pi` chooses the latent of a conditional variational autoencoder
    :math:`G` of the data's actions. It therefore chooses only actions that the data support.

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

    As published, the generator is first trained alone and then frozen: call only
    :meth:`generator_loss` at first, and then only the two others. The policy and the critics have
    targets, the generator has none.

    Args:
        generator: as for :class:`~torchrl_bmrl.objectives.BCQLoss`; it needs a latent.
        actor_network: π (observation → ``action_latent``), bounded to the region where the
            generator was trained, such as :func:`torchrl_bmrl.modules.make_latent_actor`.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            its own initialisation, or one critic, which is copied ``num_qvalue_nets`` times.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        num_qvalue_nets: number of critics; ``None``: 2 from a single critic, or the list's length.
        lmbda: λ, weight of the critics' minimum; the weight of their maximum is 1 - λ.
        **options: as for :class:`~torchrl_bmrl.objectives.BCQLoss`, but no ``latent_clip``.

    Keys read and written: as :class:`~torchrl_bmrl.objectives.BCQLoss`.

    Raises:
        BMRLError: as :class:`~torchrl_bmrl.objectives.BCQLoss`.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_latent_actor, make_qvalue_network
        >>> generator = ActionVAE(observation_dim=3, action_dim=2)
        >>> actor = make_latent_actor(observation_dim=3, latent_dim=generator.latent_dim)
        >>> loss = PLASLoss(generator, actor, make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> flag = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.randn(8, 3), "reward": torch.randn(8, 1)}
        >>> after |= {"done": flag, "terminated": flag}
        >>> data = {"observation": torch.randn(8, 3), "action": torch.rand(8, 2) * 2 - 1}
        >>> data = TensorDict(data | {"next": after}, batch_size=[8])
        >>> losses = loss(data)
        >>> (losses["loss_qvalue"] + losses["loss_actor"]).backward()
    """

    terms = ("generator", "qvalue", "actor")
    fixed_options = ("latent_clip",)
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
        num_qvalue_nets: int | None = None,
        lmbda: float = 0.75,
        **options: Any,
    ) -> None:
        super().__init__(generator, perturbation_network, latent_clip=None, **options)
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

    # -- losses, in update order; the base has generator_loss ------------------------------------

    def act(self, observation: TensorDictBase, *, target: bool = False) -> TensorDictBase:
        """The observation with the policy's action.

        Args:
            observation: what policy and decoder read, batch ``[*B]``.
            target: whether the action is the target policy's.
        """
        acted = self.call("actor_network", observation.copy(), target=target)
        latent = written(acted, self.tensor_keys.action_latent, self.actor_network)
        decoded = self.decode(observation, latent)
        return self.perturb(decoded, target=target)

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them; only the critics receive gradients.

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
        return self.temporal_difference(tensordict, self.qvalue(data), next_value)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """-Q of the first critic at the policy's action; trains only policy and perturbation.

        Returns:
            the loss, and no metrics.
        """
        acted = self.act(self.rows(tensordict, self.observation_keys))
        value = self.qvalue(acted, frozen=True)[0]
        return self.reduce(-value, tensordict), {}
