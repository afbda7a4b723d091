"""Base of the losses with critics; docs/extending.md shows how to derive a loss from it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torchrl.objectives.utils import ValueEstimators, _vmap_func, distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import average, unpadded
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.base import KeyedLoss
from torchrl_bmrl.objectives.checks import check_choice, check_network, check_number
from torchrl_bmrl.objectives.data import missing, next_key, select
from torchrl_bmrl.objectives.ensemble import Ensemble, can_stack, copies
from torchrl_bmrl.objectives.estimators import make_estimator, outcomes
from torchrl_bmrl.objectives.sizes import parts_of, shapes_of, warm_up
from torchrl_bmrl.objectives.swap import holding, read, shared_keys, unbound
from torchrl_bmrl.ownership import note_copied

LOSS_FUNCTIONS = ("l2", "l1", "smooth_l1")

Self = TypeVar("Self", bound="OfflineLoss")


class OfflineLoss(KeyedLoss):
    """Base of losses that learn one critic, or an ensemble of critics, from a fixed batch.

    It provides the critics (:meth:`convert_critics`, :meth:`qvalue`), the value estimators
    (:meth:`temporal_difference`), and checked access to the data (:meth:`rows`). A subclass names
    its losses in ``terms``, in update order. The method ``actor_loss`` computes the term
    ``"actor"`` and returns it with a dict of metrics; the output has it as ``loss_actor``.

    Keyword Args:
        gamma: discount of the default TD(0) estimator.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"`` (Huber) between value and target.
        separate_losses: whether parameters that a network shares with the ``generator`` receive
            gradients from the generator's loss only.
        reduction, deactivate_vmap, use_prioritized_weights: see :class:`KeyedLoss`.

    Raises:
        UnknownNameError: for another ``loss_function`` or ``reduction``.
        BMRLError: for ``gamma`` outside [0, 1].

    Example:
        >>> from torchrl_bmrl.modules import make_qvalue_network
        >>> loss = OfflineLoss(gamma=0.9)  # as in a subclass
        >>> loss.convert_critics(make_qvalue_network(3, 2), num_qvalue_nets=2)
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> loss.qvalue(data).shape, loss.qvalue(data, target=True).shape
        (torch.Size([2, 8]), torch.Size([2, 8]))
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename."""

        action: NestedKey = "action"
        state_action_value: NestedKey = "state_action_value"  # the critics' output
        reward: NestedKey = "reward"  # this and the flags lie under "next"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"  # only this flag stops the bootstrap
        priority: NestedKey = "td_error"  # written to the input
        priority_weight: NestedKey = "priority_weight"  # read from the input where present

    terms: Any = ()
    metrics: Any = ("pred_value", "target_value", "next_state_value")
    tensor_keys: Any
    default_keys: Any = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS: ClassVar = (
        ValueEstimators.TD0,
        ValueEstimators.TD1,
        ValueEstimators.TDLambda,
    )

    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    def __init__(
        self,
        *,
        gamma: float = 0.99,
        loss_function: str = "l2",
        separate_losses: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._gamma = check_number("gamma", gamma, 0, 1)
        self.loss_function = check_choice("loss_function", loss_function, LOSS_FUNCTIONS)
        self.separate_losses = separate_losses

    # -- construction ----------------------------------------------------------------------------

    def convert_critics(
        self,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        num_qvalue_nets: int | None,
        *,
        default: int = 2,
    ) -> None:
        """Registers the critics and their targets; call it after all other networks.

        Args:
            qvalue_network: list of critics, each with its own initialisation, or one critic, which
                is copied to ``num_qvalue_nets`` critics, each copy initialised anew.
            num_qvalue_nets: number of critics; ``None`` for the length of the list, or ``default``.
            default: number of critics made from a single one.

        Raises:
            BMRLError: for no critics, a number that is not the list's length, a critic that reads
                entries of other sizes than the other networks, or a single critic that cannot be
                initialised anew.
        """
        several = isinstance(qvalue_network, (Sequence, nn.ModuleList))
        critics: list[Any] = list(qvalue_network) if several else [qvalue_network]
        for critic in critics:
            check_network("a critic" if several else "qvalue_network", critic)
            self.check_sizes("qvalue_network", critic)
        if not several:
            count = default if num_qvalue_nets is None else num_qvalue_nets
            count = check_number("num_qvalue_nets", count, 1, integer=True)
            critics = copies(critics[0], count, list(self.parameters()))
        elif not critics or num_qvalue_nets not in (None, len(critics)):
            raise BMRLError(
                f"qvalue_network is a list of {len(critics)} critics and num_qvalue_nets is "
                f"{num_qvalue_nets}; valid: at least one critic, and their number or None"
            )
        self.num_qvalue_nets = len(critics)
        self._flat_rows = any(
            isinstance(part, _BatchNorm) for critic in critics for part in critic.modules()
        )
        self._stacked = can_stack(critics, self.parameters())
        for critic in critics if self._stacked else ():
            note_copied(critic, type(self).__name__)
        network, size = (critics, len(critics)) if self._stacked else (Ensemble(critics), None)
        self.convert_to_functional(
            network, "qvalue_network", expand_dim=size, create_target_params=True
        )

    def finish(self) -> None:
        """Ends a subclass's ``__init__``: makes the value estimator and finds shared parameters."""
        self.make_value_estimator(self.default_value_estimator)
        self.keep_keys()
        self._shared_with_generator = shared_keys(self)

    def _parameters_changed(self) -> None:
        super()._parameters_changed()
        self._shared_with_generator = shared_keys(self)

    def _warm_up(self, tensordict: TensorDictBase, batch: torch.Size) -> None:
        """Gives lazy networks their parameters, by the sizes of the first batch."""
        self._cold = False
        shapes = shapes_of(tensordict, self.in_keys, len(batch))
        if (latent := getattr(vars(self).get("generator"), "latent_dim", None)) is not None:
            shapes[getattr(self.tensor_keys, "action_latent", "action_latent")] = (latent,)
        for name, network in vars(self).items():
            for part in parts_of(network) if isinstance(network, nn.Module) else ():
                warm_up(name, part, shapes)

    def written_keys(self) -> list[str]:
        """The terms in update order, then the metrics."""
        terms = [f"loss_{term}" for term in self.terms]
        return [*terms, *self.metrics] if terms else super().written_keys()

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes every term with the current parameters, and writes the priority to the input."""
        losses: dict[str, Tensor] = {}
        metrics: dict[str, Tensor] = {}
        for term in self.terms:
            losses[f"loss_{term}"], own = getattr(self, f"{term}_loss")(tensordict)
            metrics |= own
        tensordict.set(self.tensor_keys.priority, metrics.pop("td_error").amax(0))
        return TensorDict(losses | metrics)

    # -- critics ---------------------------------------------------------------------------------

    def critic(self, index: int = 0) -> tuple[TensorDictModule, TensorDictBase]:
        """One critic: its module, and the parameters to run it with.

        Args:
            index: of the critic, below ``num_qvalue_nets``.
        """
        if self._stacked:
            return self.qvalue_network, self.qvalue_network_params[index]
        params = self.qvalue_network_params["critics", str(index)]
        return self.qvalue_network.critics[index], params

    def evaluate(
        self,
        tensordict: TensorDictBase,
        key: NestedKey,
        *,
        target: bool = False,
        frozen: bool = False,
    ) -> Tensor:
        """One output of all critics, ``(num_qvalue_nets, *B, n)``.

        Args:
            tensordict: what they read, batch ``[*B]``.
            key: the output.
            target: whether the targets' parameters are used.
            frozen: whether their parameters receive no gradient.

        Raises:
            BMRLError: if the data do not fit the critics, or these do not write the key.
        """
        network = self.qvalue_network
        inputs = tensordict.select(*network.in_keys)
        if self._flat_rows and inputs.ndim > 1:
            # With more than two dimensions a BatchNorm takes the second for its features.
            values = self.evaluate(inputs.reshape(-1), key, target=target, frozen=frozen)
            return values.unflatten(1, inputs.batch_size)
        if not self._stacked:
            values = self.call("qvalue_network", inputs, target=target, frozen=frozen)
            return written(values, key, network)
        if self.critics_in_sequence:
            weights = self.weights("qvalue_network", target=target, frozen=frozen)
            outputs = []
            for own in unbound(weights):
                with holding(network, own):
                    outputs.append(written(read(network, inputs.copy()), key, network))
            return torch.stack(outputs)
        # A new function at every call: a stored one could not be pickled, and a copy of the loss
        # would run the original's network.
        run = _vmap_func(network, (None, 0), randomness=self.vmap_randomness)
        params = getattr(self, f"{'target_' if target else ''}qvalue_network_params")
        return written(run(inputs, params.detach() if frozen else params), key, network)

    @property
    def critics_in_sequence(self) -> bool:
        """Whether critics run one after the other: on a CPU that is faster than under vmap."""
        return self.deactivate_vmap or next(self.parameters()).device.type == "cpu"

    def qvalue(
        self, tensordict: TensorDictBase, *, target: bool = False, frozen: bool = False
    ) -> Tensor:
        """Q of each critic, ``(num_qvalue_nets, *B)``.

        Args:
            tensordict: what the critics read, batch ``[*B]``.
            target: whether the targets' parameters are used.
            frozen: whether their parameters receive no gradient.

        Raises:
            BMRLError: if the critics' output is not ``(*B, 1)``.
        """
        key = self.tensor_keys.state_action_value
        value = self.evaluate(tensordict, key, target=target, frozen=frozen)
        if value.shape[-1] != 1:
            raise BMRLError(f"the critics' {key!r} has shape {tuple(value.shape)}; valid: (*B, 1)")
        return value.squeeze(-1)

    # -- value estimator and target --------------------------------------------------------------

    @property
    def outcome_keys(self) -> list[NestedKey]:
        """Keys of reward, done and terminated, under ``"next"``."""
        keys = self.tensor_keys
        return [next_key(key) for key in (keys.reward, keys.done, keys.terminated)]

    def _estimator_keys(self) -> dict[str, NestedKey]:
        own = {name: getattr(self.tensor_keys, name) for name in ("reward", "done", "terminated")}
        return {"value": self.tensor_keys.state_action_value, **own}

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._estimator_keys())
        super()._forward_value_estimator_keys()

    @property
    def gamma(self) -> float:
        """Discount of the value estimator; an assignment changes the estimator's."""
        held = getattr(self._value_estimator, "gamma", None)
        # The estimator's has its own dtype, in which 0.99 is another number.
        if held is not None and held.item() != torch.tensor(self._gamma, dtype=held.dtype).item():
            self._gamma = held.item()
        return self._gamma

    @gamma.setter
    def gamma(self, value: float) -> None:
        self._gamma = check_number("gamma", value, 0, 1)
        self.value_estimator.gamma.fill_(self._gamma)

    def make_value_estimator(
        self: Self,
        value_type: ValueEstimators | ValueEstimatorBase | type | None = None,
        **hyperparams: Any,
    ) -> Self:
        """Chooses the estimator of the critics' target; returns the loss itself.

        Args:
            value_type: a member of ``SUPPORTED_VALUE_ESTIMATORS``, or an estimator of your own
                (class or instance, made with ``value_network=None``: the loss writes the next
                value into the data).
            **hyperparams: of the estimator, such as ``gamma`` and ``lmbda``.
        """
        self._gamma = make_estimator(
            self, value_type or self.default_value_estimator, self._estimator_keys(), hyperparams
        )
        return self

    def td_target(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        """Target of the critics from the value of the next states, ``(*B,)``, without gradient.

        Args:
            tensordict: the data, with reward and flags under ``"next"``.
            next_value: value of the next states, ``(*B,)``.

        Raises:
            BMRLError: for a reward or flag that is missing, not ``(*B, 1)`` or not finite.
        """
        keys = self.tensor_keys
        valid = self.valid_rows(tensordict, next_value.shape)
        next_value = next_value.unsqueeze(-1)
        data = tensordict.copy().set(next_key(keys.state_action_value), next_value)
        for key, value in outcomes(tensordict, keys, valid, next_value.shape).items():
            data.set(key, value)
        return self.value_estimator.value_estimate(data).squeeze(-1).detach()

    def temporal_difference(
        self, tensordict: TensorDictBase, predicted: Tensor, next_value: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        r"""Distance of the critics from their target, :math:`\sum_j d(Q_j(s, a), y)`.

        Args:
            tensordict: the data.
            predicted: Q of each critic at the data's actions, ``(num_qvalue_nets, *B)``.
            next_value: value of the next states, ``(*B,)``.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``. Masked rows have the error 0 and count in no
            mean.
        """
        target = self.td_target(tensordict, next_value)
        distance = distance_loss(predicted, target.expand_as(predicted), self.loss_function)
        valid = self.valid_rows(tensordict, target.shape)
        return self.reduce(distance.sum(0), tensordict), {
            "td_error": unpadded((predicted - target).detach().square(), valid),
            "pred_value": average(predicted, valid),
            "target_value": average(target, valid),
            "next_state_value": average(next_value, valid),
        }

    # -- data ------------------------------------------------------------------------------------

    def batch_shape(self, tensordict: TensorDictBase) -> torch.Size:
        """The shape ``*B`` of the data, by their action; keyword calls have no batch size.

        Raises:
            BMRLError: if the data have no action, or no row, or a network reads an entry under a
                name that ``set_keys`` has replaced.
        """
        self.check_names()
        key = self.tensor_keys.action
        action = tensordict.get(key, None)
        if action is None:
            raise missing(tensordict, key, self.readers(key))
        batch = self._batch_of(action, tensordict.ndim)
        if self._cold:
            self._warm_up(tensordict, batch)
        if not action.numel():
            raise BMRLError(f"{key!r} has the shape {tuple(action.shape)}; valid: one row at least")
        return batch

    def _batch_of(self, action: Tensor, ndim: int) -> torch.Size:
        return action.shape[:-1]

    def rows(
        self, tensordict: TensorDictBase, keys: Iterable[NestedKey], *, after: bool = False
    ) -> TensorDictBase:
        """The entries of some keys, now or ``after`` the step, with the batch size ``*B``.

        Args:
            tensordict: the data.
            keys: of the entries, as networks read them.
            after: whether to return those under ``"next"``, without that prefix.

        Raises:
            BMRLError: for a missing key, a number that is not finite, or another batch shape.
        """
        batch = self.batch_shape(tensordict)
        valid, under = self.valid_rows(tensordict, batch), "next" if after else ()
        return select(tensordict, keys, batch, valid, under=under, readers=self.readers)
