"""Base of the losses whose policy stays close to a generative model of the data's actions."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Bounded, TensorSpec

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import average, perturbed_action
from torchrl_bmrl.generators import (
    LOSS_OPTIONS,
    PROPOSAL_OPTIONS,
    as_generator,
    check_bounds,
    written,
)
from torchrl_bmrl.objectives.checks import check_choice, check_network, leaf_of
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.data import check_same_shape, check_within, next_key
from torchrl_bmrl.objectives.swap import holding, unfit

KL_REDUCTIONS = ("mean", "sum")


class GenerativeLoss(OfflineLoss):
    r"""Base of losses with a generator of the data's actions.

    It provides the generator's own loss (:meth:`generator_loss`), its proposals (:meth:`propose`)
    and, for a generator with a latent, the map from the latent to an action (:meth:`decode`) and
    back (:meth:`encode`). The generator has no target.

    Args:
        generator: model of the data's actions, see :mod:`torchrl_bmrl.generators`; such as
            :class:`torchrl_bmrl.modules.ActionVAE`. A module with ``encoder`` (observation, action
            → ``action_latent_loc``, ``action_latent_scale``), ``decoder`` (observation,
            ``action_latent`` → action) and ``latent_dim`` is used as an autoencoder.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        kl_weight: β, of an autoencoder.
        kl_reduction: whether an autoencoder's divergence is the ``"mean"`` (as published) or the
            ``"sum"`` over the latent's dimensions.
        latent_clip: bound on the latent of proposed actions, ``None`` for none.
        max_perturbation: φ, a share of half the action's range in each dimension.
        **options: of :class:`~torchrl_bmrl.objectives.common.OfflineLoss`.

    Raises:
        BMRLError: for a generator that lacks a part, bounds and spec given together or not at all,
            bounds that are not the generator's or of another length than its actions, networks
            whose sizes differ, an unknown ``kl_reduction``, or an option that the generator does
            not take; and on CPU at a call for actions outside the bounds.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> loss = GenerativeLoss(ActionVAE(3, 2), bounds=(-1.0, 1.0))  # as in a subclass
        >>> loss.convert_critics(make_qvalue_network(3, 2), num_qvalue_nets=2)
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> value, metrics = loss.generator_loss(data)
        >>> value.shape, sorted(metrics)
        (torch.Size([]), ['kl_divergence', 'reconstruction_error'])
    """

    @dataclass
    class _AcceptedKeys(OfflineLoss._AcceptedKeys):
        """Keys that ``set_keys`` can rename: those of the base and these."""

        action_latent: NestedKey = "action_latent"  # the VAE's z, read by the decoder
        action_latent_loc: NestedKey = "action_latent_loc"  # mean of the encoder's posterior
        action_latent_scale: NestedKey = "action_latent_scale"  # its standard deviation
        perturbation: NestedKey = "perturbation"  # the perturbation network's output

    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"kl_weight", "latent_clip", "max_perturbation"})
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
        latent_clip: float | None = None,
        max_perturbation: float = 0.05,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        generator = as_generator(generator)
        self.kl_reduction = check_choice("kl_reduction", kl_reduction, KL_REDUCTIONS)
        self.check_sizes("generator", generator)
        self.convert_to_functional(generator, "generator", create_target_params=False)
        low, high = action_bounds(action_spec, bounds, self.tensor_keys.action)
        size = (getattr(generator, "sizes", None) or {}).get(self.tensor_keys.action)
        check_bounds((low, high), generator, size)
        register_bounds(self, low, high)
        if perturbation_network is None:
            self.perturbation_network = None
        else:
            check_network("perturbation_network", perturbation_network)
            self.check_sizes("perturbation_network", perturbation_network)
            self.convert_to_functional(
                perturbation_network, "perturbation_network", create_target_params=True
            )
        self.register_coefficients(max_perturbation=max_perturbation)
        self._refuse_unread(kl_weight=kl_weight, kl_reduction=kl_reduction, latent_clip=latent_clip)
        if "kl_weight" in generator.options:
            self.register_coefficients(kl_weight=kl_weight)
        clip = latent_clip if "latent_clip" in generator.options else None
        self.register_coefficients(latent_clip=clip, optional=True)

    def _refuse_unread(self, **options: Any) -> None:
        """Raises for an option with another value than its default that the generator lacks."""
        parameters = inspect.signature(type(self)).parameters
        for name, value in options.items():
            given = name in parameters and value != parameters[name].default
            if given and name not in self.generator.options:
                raise BMRLError(
                    f"{name} is {value!r}, and generator {type(self.generator).__name__} does not "
                    f"take it; valid: its options, {', '.join(self.generator.options) or 'none'}"
                )

    def _options(self, names: tuple[str, ...]) -> dict[str, Any]:
        """The values of those options that the generator takes."""
        return {name: getattr(self, name) for name in names if name in self.generator.options}

    @property
    def observation_keys(self) -> list[NestedKey]:
        """Keys that the generator and ``state_networks`` read of a state."""
        networks = [getattr(self, name) for name in self.state_networks]
        keys = [key for network in networks if network is not None for key in network.in_keys]
        made = (self.tensor_keys.action_latent, self.tensor_keys.action)
        keys = [*getattr(self.generator, "decoder", self.generator).in_keys, *keys]
        return [key for key in dict.fromkeys(keys) if key not in made]

    def read_keys(self) -> Iterable[NestedKey]:
        """Observation and action, and what followed."""
        now = dict.fromkeys([*self._training_keys, *self.observation_keys])
        after = map(next_key, self.observation_keys)
        return [*now, self.tensor_keys.action, *after, *self.outcome_keys]

    @property
    def _training_keys(self) -> list[NestedKey]:
        """Keys that the generator's own loss reads beside the action."""
        return getattr(self.generator, "encoder", self.generator).in_keys

    @property
    def metrics(self) -> list[str]:
        """Names of the metrics: the generator's, then the critics'."""
        return [*self.generator.metrics, *OfflineLoss.metrics]

    # -- proposed actions ------------------------------------------------------------------------

    def propose(self, observation: TensorDictBase, num_candidates: int) -> TensorDictBase:
        """The observation with proposed actions, each drawn independently.

        The generator receives no gradient.

        Args:
            observation: what the generator reads of a state, batch ``[*B]``.
            num_candidates: actions for each state.

        Returns:
            batch ``[*B, num_candidates]``.

        Raises:
            BMRLError: if the observation does not fit the generator, or this writes other keys.
        """
        keys = self.tensor_keys
        options = self._options(PROPOSAL_OPTIONS)
        with holding(self.generator, self.weights("generator", frozen=True)):
            proposed = self._ask(self.generator.propose, observation, num_candidates, **options)
        if proposed.get(keys.action, None) is None:
            written(proposed, keys.action, self.generator)
        return proposed

    def decode(self, observation: TensorDictBase, latent: Tensor) -> TensorDictBase:
        """The observation with the latent and the action decoded from it.

        The latent may receive a gradient, the generator does not.

        Args:
            observation: what the decoder reads beside z, batch ``[*B]``.
            latent: z, ``(*B, latent_dim)``.

        Raises:
            BMRLError: if they do not fit the decoder, or the generator has no latent.
        """
        data = observation.copy().set(self.tensor_keys.action_latent, latent)
        return self._with_latent("decode", data)

    def encode(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The data with the mean and standard deviation of the posterior of z.

        The action may receive a gradient, the generator does not.

        Args:
            tensordict: observation and action, batch ``[*B]``.

        Returns:
            the same with ``action_latent_loc`` and ``action_latent_scale``, ``(*B, latent_dim)``.

        Raises:
            BMRLError: if they do not fit the encoder, or the generator has no latent.
        """
        return self._with_latent("encode", tensordict)

    def _with_latent(self, method: str, data: TensorDictBase) -> TensorDictBase:
        if not hasattr(self.generator, method):
            raise BMRLError(
                f"generator {type(self.generator).__name__} has no {method}(); valid: a generator "
                "with a latent, such as torchrl_bmrl.modules.ActionVAE"
            )
        with holding(self.generator, self.weights("generator", frozen=True)):
            return self._ask(getattr(self.generator, method), data)

    def _ask(self, method: Any, data: TensorDictBase, *args: Any, **options: Any) -> Any:
        """Calls a method of the generator and explains errors about the data."""
        if torch.compiler.is_compiling():
            return method(data, *args, self.tensor_keys, **options)
        try:
            return method(data, *args, self.tensor_keys, **options)
        except torch.OutOfMemoryError:
            raise
        except (RuntimeError, KeyError) as error:
            reads_action = method.__name__ in ("row_loss", "encode")
            also = [self.tensor_keys.action] if reads_action else []
            raise unfit(self.generator, data, error, also) from error

    def perturb(self, tensordict: TensorDictBase, *, target: bool = False) -> TensorDictBase:
        """Adds the perturbation network's output to the action, if there is such a network.

        Args:
            tensordict: observation and action, batch ``[*B]``.
            target: whether the target network is used.

        Raises:
            BMRLError: if the perturbation has another shape than the action.
        """
        if self.perturbation_network is None:
            return tensordict
        keys = self.tensor_keys
        tensordict = self.call("perturbation_network", tensordict, target=target)
        action = tensordict.get(keys.action)
        perturbation = written(tensordict, keys.perturbation, self.perturbation_network)
        check_same_shape(keys.perturbation, perturbation, action)
        action = perturbed_action(
            action, perturbation, self.max_perturbation, self.action_low, self.action_high
        )
        return tensordict.set(keys.action, action)

    # -- loss ------------------------------------------------------------------------------------

    def generator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the generator, such as :meth:`.Autoencoder.row_loss`; only it receives gradients.

        Returns:
            the loss and, detached, the generator's metrics: of an autoencoder
            ``reconstruction_error`` and ``kl_divergence``.

        Raises:
            BMRLError: for data with missing keys, other shapes or, on CPU and not compiled, numbers
                that are not finite or actions outside the bounds.
        """
        action = self.tensor_keys.action
        keys = [*self._training_keys, *self.observation_keys, action]
        data = self.rows(tensordict, dict.fromkeys(keys))
        valid = self.valid_rows(tensordict, data.batch_size)
        check_within(action, data.get(action), self.action_low, self.action_high, valid)
        with holding(self.generator, self.weights("generator")):
            loss, metrics = self._ask(self.generator.row_loss, data, **self._options(LOSS_OPTIONS))
        loss = self.reduce(loss, tensordict)
        return loss, {name: average(value, valid) for name, value in metrics.items()}


def register_bounds(loss: OfflineLoss, low: Tensor, high: Tensor) -> None:
    """Registers the action's bounds as buffers ``action_low`` and ``action_high``.

    Args:
        loss: with a network, whose dtype and device the buffers get.
        low: lower bound, ``()`` or ``(action_dim,)``.
        high: upper bound, likewise.
    """
    loss.register_buffer("action_low", low.to(**loss._type_and_device))
    loss.register_buffer("action_high", high.to(**loss._type_and_device))


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
        action_spec = leaf_of(action_spec, action_key)
        if not isinstance(action_spec, Bounded):
            raise BMRLError(f"action_spec is a {type(action_spec).__name__}; valid: Bounded")
        bounds = (action_spec.space.low, action_spec.space.high)
    # Numbers in float64: in a float64 loss 0.4 must not become 0.4 in float32. And on the CPU: on
    # the meta device, where networks may be built for their shapes, they could not be checked.
    low, high = (
        bound
        if isinstance(bound, Tensor) and bound.is_floating_point()
        else torch.as_tensor(
            list(bound) if isinstance(bound, Sequence) else bound, dtype=torch.float64, device="cpu"
        )
        for bound in bounds
    )
    if low.ndim > 1 or high.ndim > 1:
        raise BMRLError(
            f"the bounds of the action have the shapes {tuple(low.shape)} and {tuple(high.shape)}; "
            "valid: () or (action_dim,), so of several environments the spec of one"
        )
    if not (low.isfinite().all() and high.isfinite().all()):
        raise BMRLError(
            f"the bounds of the action are {low.tolist()} and {high.tolist()}; valid: finite "
            "numbers, such as the smallest and largest action of the data"
        )
    if not (low <= high).all():
        raise BMRLError(f"the lower bound {low} of the action is above the upper bound {high}")
    return low, high
