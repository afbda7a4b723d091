"""Batch-Constrained Q-learning as a TorchRL loss module."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Bounded, Composite, TensorSpec
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import (
    ValueEstimators,
    _vmap_func,
    dispatch_value_estimator,
    distance_loss,
)
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import (
    bcq_next_value,
    gaussian_kl,
    perturbed_action,
    sample_action_latent,
    squared_error,
)

LOSS_FUNCTIONS = ("l2", "l1", "smooth_l1")
REDUCTIONS = ("mean", "sum", "none")


class BCQLoss(LossModule):
    r"""Batch-Constrained deep Q-learning.

    A conditional variational autoencoder :math:`G` learns which actions the data hold; the critics
    :math:`Q_j` bootstrap only from actions that :math:`G` proposes.

    Reference: Fujimoto et al., *Off-Policy Deep Reinforcement Learning without Exploration*, ICML
    2019, https://arxiv.org/abs/1812.02900, algorithm 1.

    Losses, in update order:

    1. :meth:`generator_loss`:
       :math:`\lVert G(s, z) - a \rVert^2 / |a| + \beta\, \mathrm{KL}(q(z|s,a)\,\|\,N(0, I)) / |z|`
    2. :meth:`qvalue_loss`: :math:`\sum_j (Q_j(s, a) - y)^2` with
       :math:`y = r + \gamma (1 - \mathrm{terminated}) \max_i
       [\lambda \min_j Q'_j(s', a_i) + (1 - \lambda) \max_j Q'_j(s', a_i)]`, where
       :math:`a_i = G(s', z_i)`, :math:`z_i \sim N(0, I)` clipped to ±``latent_clip``
    3. :meth:`perturbation_loss` (only with a ``perturbation_network``):
       :math:`-Q_1(s, a + \phi\,\xi(s, a))` with :math:`a = G(s, z)`

    :meth:`forward` computes all of them with the present parameters; a loop that follows the
    published order calls the three methods one after the other and steps each optimizer between.
    There is no target generator. Targets move only under
    :class:`~torchrl.objectives.SoftUpdate` or :class:`~torchrl.objectives.HardUpdate`.

    Args:
        generator: a module with two :class:`~tensordict.nn.TensorDictModule` children: ``encoder``
            (observation, action → ``action_latent_loc``, ``action_latent_scale``) and ``decoder``
            (observation, ``action_latent`` → action), and ``latent_dim``, the size of z, such as
            :class:`torchrl_bmrl.modules.ActionVAE`.
        qvalue_network: list of critics (observation, action → ``state_action_value``), each with
            an initialisation of its own.
        perturbation_network: optional module (observation, action → ``perturbation`` in [-1, 1]).

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        num_candidates: actions proposed per next state. Default 10.
        lmbda: λ, weight of the critics' minimum against their maximum. Default 0.75.
        latent_clip: bound on the latent of proposed actions; ``None`` turns it off. Default 0.5.
        kl_weight: β. Default 0.5, as published.
        max_perturbation: φ. Default 0.05.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"`` between value and target.
        gamma: discount of the default TD(0) estimator. Default 0.99.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        deactivate_vmap: run the critics in a loop and not under :func:`torch.vmap`.
        use_prioritized_weights: ``True``, ``False`` or ``"auto"``, as in TorchRL's losses.

    Keys read: ``observation (*B, obs_dim)``, ``action (*B, action_dim)``, and under ``"next"``
    ``observation``, ``reward``, ``done``, ``terminated``, each of the last three ``(*B, 1)``.
    Key written to the input: ``td_error (*B,)``, the priority.

    Raises:
        BMRLError: for candidates below one, λ outside [0, 1], a generator without encoder,
            decoder and ``latent_dim``, critics that are not a list, an unknown ``loss_function`` or
            ``reduction``, or bounds and spec given together or not at all.

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

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename.

        Attributes:
            action: action of the data, and what decoder and perturbed actions are called.
            action_latent: the VAE's z, read by the decoder.
            action_latent_loc: mean of the encoder's posterior.
            action_latent_scale: its standard deviation.
            perturbation: the perturbation network's output.
            state_action_value: the critics' output.
            reward: under ``"next"``.
            done: under ``"next"``.
            terminated: under ``"next"``; only this stops the bootstrap.
            priority: written to the input.
            priority_weight: read from the input where present.
        """

        action: NestedKey = "action"
        action_latent: NestedKey = "action_latent"
        action_latent_loc: NestedKey = "action_latent_loc"
        action_latent_scale: NestedKey = "action_latent_scale"
        perturbation: NestedKey = "perturbation"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS = (
        ValueEstimators.TD0,
        ValueEstimators.TD1,
        ValueEstimators.TDLambda,
    )

    generator: TensorDictModule
    generator_params: TensorDictParams
    target_generator_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    perturbation_network: TensorDictModule | None
    perturbation_network_params: TensorDictParams | None
    target_perturbation_network_params: TensorDictParams | None

    def __init__(
        self,
        generator: TensorDictModule,
        qvalue_network: list[TensorDictModule],
        perturbation_network: TensorDictModule | None = None,
        *,
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        num_candidates: int = 10,
        lmbda: float = 0.75,
        latent_clip: float | None = 0.5,
        kl_weight: float = 0.5,
        max_perturbation: float = 0.05,
        loss_function: str = "l2",
        gamma: float = 0.99,
        reduction: str = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__()
        if num_candidates < 1:
            raise BMRLError(f"num_candidates is {num_candidates}; valid: at least 1")
        if not 0.0 <= lmbda <= 1.0:
            raise BMRLError(f"lmbda is {lmbda}; valid: between 0 and 1")
        for part in ("encoder", "decoder", "latent_dim"):
            if not hasattr(generator, part):
                raise BMRLError(
                    f"generator {type(generator).__name__} has no {part!r}; valid: a module with "
                    "'encoder', 'decoder' and 'latent_dim', such as "
                    "torchrl_bmrl.modules.ActionVAE"
                )
        if not isinstance(qvalue_network, (list, tuple)) or not qvalue_network:
            given = type(qvalue_network).__name__
            raise BMRLError(
                f"qvalue_network is {'an empty' if not qvalue_network else 'a'} {given}; valid: a "
                "list of critics, each with an initialisation of its own"
            )
        if loss_function not in LOSS_FUNCTIONS:
            raise UnknownNameError("loss_function", loss_function, LOSS_FUNCTIONS)
        if reduction not in REDUCTIONS:
            raise UnknownNameError("reduction", reduction, REDUCTIONS)
        self._in_keys: list[NestedKey] | None = None
        self.num_candidates = num_candidates
        self.num_qvalue_nets = len(qvalue_network)
        self.loss_function = loss_function
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights
        self.gamma = gamma

        self.convert_to_functional(generator, "generator", create_target_params=False)
        self.convert_to_functional(
            list(qvalue_network),
            "qvalue_network",
            expand_dim=self.num_qvalue_nets,
            create_target_params=True,
        )
        if perturbation_network is None:
            self.perturbation_network = None
        else:
            self.convert_to_functional(
                perturbation_network, "perturbation_network", create_target_params=True
            )
        reference = next(generator.parameters())
        low, high = _action_bounds(action_spec, bounds, self.tensor_keys.action)
        self.register_buffer("action_low", low.to(reference))
        self.register_buffer("action_high", high.to(reference))
        for name, value in (
            ("lmbda", lmbda),
            ("latent_clip", latent_clip),
            ("kl_weight", kl_weight),
            ("max_perturbation", max_perturbation),
        ):
            self.register_coeff_buffer(name, value, device=reference.device, dtype=reference.dtype)
        self.make_value_estimator(self.default_value_estimator)
        self._make_vmap()

    # -- keys ----------------------------------------------------------------------------------

    def _make_vmap(self) -> None:
        self._vmap_qvalue_network = _vmap_func(
            self.qvalue_network,
            (None, 0),
            randomness=self.vmap_randomness,
            pseudo_vmap=self.deactivate_vmap,
        )

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(
                value=self.tensor_keys.state_action_value,
                reward=self.tensor_keys.reward,
                done=self.tensor_keys.done,
                terminated=self.tensor_keys.terminated,
            )
        self._in_keys = None

    def make_value_estimator(
        self,
        value_type: ValueEstimators | ValueEstimatorBase | type | None = None,
        **hyperparams: Any,
    ) -> BCQLoss:
        """Chooses the estimator of the critics' target; returns the loss itself."""
        value_type = value_type or self.default_value_estimator
        if isinstance(value_type, ValueEstimatorBase) or (
            isinstance(value_type, type) and issubclass(value_type, ValueEstimatorBase)
        ):
            LossModule.make_value_estimator(self, value_type, **hyperparams)
            self._forward_value_estimator_keys()
            return self
        # No value network: qvalue_loss writes the next value into the data.
        dispatch_value_estimator(
            self,
            value_type,
            supported=self.SUPPORTED_VALUE_ESTIMATORS,
            tensor_keys={
                "value": self.tensor_keys.state_action_value,
                "reward": self.tensor_keys.reward,
                "done": self.tensor_keys.done,
                "terminated": self.tensor_keys.terminated,
            },
            value_network=None,
            **hyperparams,
        )
        return self

    @property
    def _observation_keys(self) -> list[NestedKey]:
        latent = self.tensor_keys.action_latent
        return [key for key in self.generator.decoder.in_keys if key != latent]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the input, in a stable order."""
        if self._in_keys is None:
            keys = self.tensor_keys
            self._in_keys = list(
                dict.fromkeys(
                    [
                        *self._observation_keys,
                        keys.action,
                        *self.qvalue_network.in_keys,
                        *(_next(key) for key in self._observation_keys),
                        _next(keys.reward),
                        _next(keys.done),
                        _next(keys.terminated),
                    ]
                )
            )
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[str]:
        """Keys of the output, in the order of keyword dispatch."""
        if self._out_keys is None:
            self._out_keys = [
                "loss_generator",
                "loss_qvalue",
                *(["loss_perturbation"] if self.perturbation_network is not None else []),
                "reconstruction_error",
                "kl_divergence",
                "pred_value",
                "target_value",
                "next_state_value",
            ]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[str]) -> None:
        self._out_keys = values

    _out_keys: list[str] | None = None

    # -- networks ------------------------------------------------------------------------------

    def _qvalue(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Q of each critic, ``(num_qvalue_nets, *B)``."""
        tensordict = tensordict.select(*self.qvalue_network.in_keys)
        value = self._vmap_qvalue_network(tensordict, params)
        return value.get(self.tensor_keys.state_action_value).squeeze(-1)

    def _propose(
        self, observation: TensorDictBase, params: TensorDictParams | None
    ) -> TensorDictBase:
        """Adds to each row an action decoded from a random latent, perturbed with ``params``."""
        keys = self.tensor_keys
        latent = sample_action_latent(
            (*observation.batch_size, self.generator.latent_dim),
            latent_clip=self.latent_clip,
            device=self.action_low.device,
            dtype=self.action_low.dtype,
        )
        proposal = observation.copy().set(keys.action_latent, latent)
        with self.generator_params.to_module(self.generator, preserve_module_state=False):
            proposal = self.generator.decoder(proposal)
        if params is not None:
            proposal = self._perturb(proposal, params)
        return proposal

    def _perturb(self, tensordict: TensorDictBase, params: TensorDictParams) -> TensorDictBase:
        assert self.perturbation_network is not None  # callers have params only then
        keys = self.tensor_keys
        with params.to_module(self.perturbation_network, preserve_module_state=False):
            tensordict = self.perturbation_network(tensordict)
        action = perturbed_action(
            tensordict.get(keys.action),
            tensordict.get(keys.perturbation),
            self.max_perturbation,
            self.action_low,
            self.action_high,
        )
        return tensordict.set(keys.action, action)

    # -- losses, in update order ---------------------------------------------------------------

    def generator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Variational autoencoder's loss; gradients reach the generator alone.

        Returns:
            the loss and, detached, ``reconstruction_error`` and ``kl_divergence``.
        """
        keys = self.tensor_keys
        action = tensordict.get(keys.action)
        data = tensordict.select(*self._observation_keys, keys.action)
        with self.generator_params.to_module(self.generator, preserve_module_state=False):
            data = self.generator.encoder(data)
            loc, scale = data.get(keys.action_latent_loc), data.get(keys.action_latent_scale)
            data.set(keys.action_latent, loc + scale * torch.randn_like(scale))
            reconstruction = self.generator.decoder(data).get(keys.action)
        error = squared_error(reconstruction, action) / action.shape[-1]
        divergence = gaussian_kl(loc, scale).mean(-1)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(
            error + self.kl_weight * divergence, tensordict=tensordict, weights=weights
        )
        self._clear_weakrefs(tensordict, data, "generator_params")
        return loss, {
            "reconstruction_error": error.detach().mean(),
            "kl_divergence": divergence.detach().mean(),
        }

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Critics' loss, summed over the critics; gradients reach the critics alone.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        keys = self.tensor_keys
        weights = self._maybe_get_priority_weight(tensordict)
        data = tensordict.copy()
        with torch.no_grad():
            after = data.get("next").select(*self._observation_keys)
            after = after.unsqueeze(-1).expand(*after.batch_size, self.num_candidates)
            perturbation = (
                None
                if self.perturbation_network is None
                else self.target_perturbation_network_params
            )
            proposals = self._propose(after, perturbation)
            candidates = self._qvalue(proposals, self.target_qvalue_network_params)
            next_value = bcq_next_value(candidates, self.lmbda)
            data.set(_next(keys.state_action_value), next_value.unsqueeze(-1))
            target = self.value_estimator.value_estimate(data).squeeze(-1)
        predicted = self._qvalue(data, self.qvalue_network_params)
        loss = distance_loss(predicted, target.expand_as(predicted), self.loss_function).sum(0)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        self._clear_weakrefs(
            tensordict,
            data,
            "generator_params",
            "qvalue_network_params",
            "target_qvalue_network_params",
        )
        return loss, {
            "td_error": (predicted - target).detach().square(),
            "pred_value": predicted.detach().mean(),
            "target_value": target.mean(),
            "next_state_value": next_value.mean(),
        }

    def perturbation_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Perturbation network's loss, -Q of the first critic; gradients reach it alone.

        Raises:
            BMRLError: if the loss was made without a perturbation network.
        """
        if self.perturbation_network is None:
            raise BMRLError("this BCQLoss was made without a perturbation_network")
        with torch.no_grad():
            proposal = self._propose(tensordict.select(*self._observation_keys), None)
        proposal = self._perturb(proposal, self.perturbation_network_params)
        value = self._qvalue(proposal, self.qvalue_network_params.detach())[0]
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(-value, tensordict=tensordict, weights=weights)
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


def _next(key: NestedKey) -> tuple[str, ...]:
    return ("next", key) if isinstance(key, str) else ("next", *key)


def _action_bounds(
    action_spec: TensorSpec | None,
    bounds: tuple[float | Tensor, float | Tensor] | None,
    action_key: NestedKey,
) -> tuple[Tensor, Tensor]:
    """Lower and upper bound of the action from exactly one of the two."""
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
    low, high = (torch.as_tensor(bound) for bound in bounds)
    if (low > high).any():
        raise BMRLError(f"the lower bound {low} of the action is above the upper bound {high}")
    return low, high
