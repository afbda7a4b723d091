"""What losses share whose policy stays within a generative model of the data's actions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Bounded, Composite, TensorSpec

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import (
    gaussian_kl,
    perturbed_action,
    sample_action_latent,
    squared_error,
)
from torchrl_bmrl.objectives.checks import (
    check_network,
    check_number,
    check_same_shape,
    next_key,
    output,
    read,
)
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.swap import holding

KL_REDUCTIONS = ("mean", "sum")


class GenerativeLoss(OfflineLoss):
    r"""Base of losses around a conditional variational autoencoder of the data's actions.

    It brings the autoencoder's own loss, :meth:`generator_loss`, and the way from a latent to an
    action, :meth:`propose`, :meth:`decode` and :meth:`perturb`. The generator has no target.

    Reference: Kingma and Welling, *Auto-Encoding Variational Bayes*, ICLR 2014,
    https://arxiv.org/abs/1312.6114, conditioned on the state as in BCQ,
    https://arxiv.org/abs/1812.02900.

    Args:
        generator: a module with two :class:`~tensordict.nn.TensorDictModule` children: ``encoder``
            (observation, action → ``action_latent_loc``, ``action_latent_scale``) and ``decoder``
            (observation, ``action_latent`` → action), and ``latent_dim``, the size of z, such as
            :class:`torchrl_bmrl.modules.ActionVAE`.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        kl_weight: β.
        kl_reduction: whether the divergence is the ``"mean"`` or the ``"sum"`` over the latent's
            dimensions.
        max_perturbation: φ.
        **options: of :class:`~torchrl_bmrl.objectives.common.OfflineLoss`.

    Raises:
        BMRLError: for a generator without encoder, decoder and ``latent_dim``, bounds and spec
            given together or not at all, or an unknown ``kl_reduction``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> loss = GenerativeLoss(ActionVAE(3, 2), bounds=(-1.0, 1.0))  # as a subclass does it
        >>> loss.convert_critics(make_qvalue_network(3, 2), num_qvalue_nets=2)
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> value, metrics = loss.generator_loss(data)
        >>> value.shape, sorted(metrics)
        (torch.Size([]), ['kl_divergence', 'reconstruction_error'])
    """

    @dataclass
    class _AcceptedKeys(OfflineLoss._AcceptedKeys):
        """Keys that ``set_keys`` can rename; those of the base and these.

        Attributes:
            action_latent: the VAE's z, read by the decoder.
            action_latent_loc: mean of the encoder's posterior.
            action_latent_scale: its standard deviation.
            perturbation: the perturbation network's output.
        """

        action_latent: NestedKey = "action_latent"
        action_latent_loc: NestedKey = "action_latent_loc"
        action_latent_scale: NestedKey = "action_latent_scale"
        perturbation: NestedKey = "perturbation"

    default_keys = _AcceptedKeys
    state_networks: ClassVar[tuple[str, ...]] = ("qvalue_network", "perturbation_network")

    generator: TensorDictModule
    generator_params: TensorDictParams
    target_generator_params: TensorDictParams
    perturbation_network: TensorDictModule | None
    perturbation_network_params: TensorDictParams | None
    target_perturbation_network_params: TensorDictParams | None
    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        generator: TensorDictModule,
        perturbation_network: TensorDictModule | None = None,
        *,
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        kl_weight: float = 0.5,
        kl_reduction: str = "mean",
        max_perturbation: float = 0.05,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        for part in ("encoder", "decoder", "latent_dim"):
            if not hasattr(generator, part):
                raise BMRLError(
                    f"generator {type(generator).__name__} has no {part!r}; valid: a module with "
                    "'encoder', 'decoder' and 'latent_dim', such as "
                    "torchrl_bmrl.modules.ActionVAE"
                )
        if kl_reduction not in KL_REDUCTIONS:
            raise UnknownNameError("kl_reduction", kl_reduction, KL_REDUCTIONS)
        self.kl_reduction = kl_reduction
        self.convert_to_functional(generator, "generator", create_target_params=False)
        if perturbation_network is None:
            self.perturbation_network = None
        else:
            check_network("perturbation_network", perturbation_network)
            self.convert_to_functional(
                perturbation_network, "perturbation_network", create_target_params=True
            )
        reference = next(generator.parameters())
        low, high = action_bounds(action_spec, bounds, self.tensor_keys.action)
        self.register_buffer("action_low", low.to(reference))
        self.register_buffer("action_high", high.to(reference))
        self.register_coefficients(
            kl_weight=check_number("kl_weight", kl_weight),
            max_perturbation=check_number("max_perturbation", max_perturbation),
        )

    @property
    def observation_keys(self) -> list[NestedKey]:
        """What decoder and ``state_networks`` read of a state."""
        networks = [getattr(self, name) for name in self.state_networks]
        keys = [key for network in networks if network is not None for key in network.in_keys]
        made = (self.tensor_keys.action_latent, self.tensor_keys.action)
        keys = [*self.generator.decoder.in_keys, *keys]
        return [key for key in dict.fromkeys(keys) if key not in made]

    def read_keys(self) -> Iterable[NestedKey]:
        """Observation and action, and what followed."""
        now = dict.fromkeys([*self.generator.encoder.in_keys, *self.observation_keys])
        after = map(next_key, self.observation_keys)
        return [*now, self.tensor_keys.action, *after, *self.outcome_keys]

    # -- from a latent to an action --------------------------------------------------------------

    def decode(self, observation: TensorDictBase, latent: Tensor) -> TensorDictBase:
        """The observation with the latent and the action that the generator decodes from it.

        A gradient may reach the latent, never the generator.

        Args:
            observation: what the decoder reads beside z, batch ``[*B]``.
            latent: z, ``(*B, latent_dim)``.

        Raises:
            BMRLError: if they do not fit the decoder.
        """
        data = observation.copy().set(self.tensor_keys.action_latent, latent)
        with holding(self.generator, self.weights("generator", frozen=True)):
            return read(self.generator.decoder, data)

    def propose(
        self, observation: TensorDictBase, latent_clip: float | Tensor | None
    ) -> TensorDictBase:
        """The observation with an action decoded from z ~ N(0, I) within ± ``latent_clip``.

        Args:
            observation: what the decoder reads beside z, batch ``[*B]``; every row gets a z of its
                own, so that of an observation expanded to candidates these differ.
            latent_clip: bound on each dimension of z, ``None`` for none.
        """
        latent = sample_action_latent(
            (*observation.batch_size, self.generator.latent_dim),
            latent_clip=latent_clip,
            device=self.action_low.device,
            dtype=self.action_low.dtype,
        )
        return self.decode(observation, latent)

    def perturb(self, tensordict: TensorDictBase, *, target: bool = False) -> TensorDictBase:
        """Moves the action by the perturbation network, if there is one.

        Args:
            tensordict: observation and action, batch ``[*B]``.
            target: whether by the network's target.

        Raises:
            BMRLError: if the perturbation has another shape than the action.
        """
        if self.perturbation_network is None:
            return tensordict
        keys = self.tensor_keys
        tensordict = self.call("perturbation_network", tensordict, target=target)
        action = tensordict.get(keys.action)
        perturbation = output(tensordict, keys.perturbation, self.perturbation_network)
        check_same_shape(keys.perturbation, perturbation, action)
        action = perturbed_action(
            action, perturbation, self.max_perturbation, self.action_low, self.action_high
        )
        return tensordict.set(keys.action, action)

    # -- loss ------------------------------------------------------------------------------------

    def generator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        r"""Variational autoencoder's loss; gradients reach the generator alone.

        .. math:: \lVert G(s, z) - a \rVert^2 / |a|
            + \beta\, \mathrm{KL}(q(z|s,a)\,\|\,N(0, I)) / |z|,\quad z \sim q(z|s,a)

        With ``kl_reduction="sum"`` the divergence is not divided by :math:`|z|`.

        Returns:
            the loss and, detached, ``reconstruction_error`` and ``kl_divergence``.

        Raises:
            BMRLError: for data with missing keys, other shapes or, on CPU and not compiled, numbers
                that are not finite.
        """
        keys = self.tensor_keys
        data = self.rows(
            tensordict,
            dict.fromkeys([*self.generator.encoder.in_keys, *self.observation_keys, keys.action]),
        )
        action = data.get(keys.action)
        with holding(self.generator, self.weights("generator")):
            data = read(self.generator.encoder, data)
            loc = output(data, keys.action_latent_loc, self.generator.encoder)
            scale = output(data, keys.action_latent_scale, self.generator.encoder)
            data.set(keys.action_latent, loc + scale * torch.randn_like(scale))
            reconstruction = read(self.generator.decoder, data).get(keys.action)
        check_same_shape(keys.action, action, reconstruction)
        error = squared_error(reconstruction, action) / action.shape[-1]
        divergence = gaussian_kl(loc, scale)
        divergence = divergence.sum(-1) if self.kl_reduction == "sum" else divergence.mean(-1)
        loss = self.reduce(error + self.kl_weight * divergence, tensordict)
        self._clear_weakrefs(tensordict, data, "generator_params")
        return loss, {
            "reconstruction_error": error.detach().mean(),
            "kl_divergence": divergence.detach().mean(),
        }


def action_bounds(
    action_spec: TensorSpec | None,
    bounds: tuple[float | Tensor, float | Tensor] | None,
    action_key: NestedKey,
) -> tuple[Tensor, Tensor]:
    """Lower and upper bound of the action from exactly one of the two.

    Raises:
        BMRLError: for both or neither, a spec without bounds, or bounds in the wrong order.

    Example:
        >>> action_bounds(None, (-1.0, 1.0), "action")
        (tensor(-1., dtype=torch.float64), tensor(1., dtype=torch.float64))
    """
    if (action_spec is None) == (bounds is None):
        raise BMRLError(
            "give either action_spec or bounds; got " + ("neither" if bounds is None else "both")
        )
    if bounds is None:
        if isinstance(action_spec, Composite):
            action_spec = action_spec[action_key]
        if not isinstance(action_spec, Bounded):
            raise BMRLError(f"action_spec is a {type(action_spec).__name__}; valid: Bounded")
        bounds = (action_spec.space.low, action_spec.space.high)
    # Numbers in float64: in a float64 loss 0.4 must not become 0.4 in float32.
    low, high = (
        bound if isinstance(bound, Tensor) else torch.tensor(bound, dtype=torch.float64)
        for bound in bounds
    )
    if low.ndim > 1 or high.ndim > 1:
        raise BMRLError(
            f"the bounds of the action have the shapes {tuple(low.shape)} and {tuple(high.shape)}; "
            "valid: () or (action_dim,), so of several environments the spec of one"
        )
    if not (low <= high).all():
        raise BMRLError(f"the lower bound {low} of the action is above the upper bound {high}")
    return low, high
