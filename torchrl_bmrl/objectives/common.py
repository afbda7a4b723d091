"""What the losses of this library have in common; docs/extending.md shows how to build on it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import (
    ValueEstimators,
    _vmap_func,
    default_value_kwargs,
    dispatch_value_estimator,
    distance_loss,
)
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.objectives.base import KeyedLoss, average, unpadded
from torchrl_bmrl.objectives.checks import (
    agreed_sizes,
    check_fit,
    check_network,
    check_number,
    entry,
    is_lazy,
    missing,
    next_key,
    output,
    parts_of,
    read,
    warm_up,
)
from torchrl_bmrl.objectives.ensemble import kind
from torchrl_bmrl.objectives.swap import holding, leaves, without_gradient
from torchrl_bmrl.ownership import note_copied

LOSS_FUNCTIONS = ("l2", "l1", "smooth_l1")

Self = TypeVar("Self", bound="OfflineLoss")


class OfflineLoss(KeyedLoss):
    """Base of losses that learn one critic, or an ensemble of them, from a fixed batch.

    It brings the critics (:meth:`convert_critics`), the value estimators, the reduction with masks
    and priority weights, and the checks of the data. A subclass declares its keys, converts its
    networks, and writes one method per loss and a ``forward``.

    Keyword Args:
        gamma: discount of the default TD(0) estimator.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"`` (Huber) between value and target.
        separate_losses: parameters that a network shares with the ``generator`` are trained by
            the generator's loss alone.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; ``None`` is ``"mean"``.
        deactivate_vmap: run the critics in a loop and not under :func:`torch.vmap`.
        use_prioritized_weights: ``True``, ``False`` or ``"auto"``, as in TorchRL's losses.

    Raises:
        UnknownNameError: for another ``loss_function`` or ``reduction``.
        BMRLError: for ``gamma`` outside [0, 1].

    Example:
        >>> from torchrl_bmrl.modules import make_qvalue_network
        >>> loss = OfflineLoss(gamma=0.9)  # as a subclass does it
        >>> loss.convert_critics(make_qvalue_network(3, 2), num_qvalue_nets=2)
        >>> data = TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 2)}, [8])
        >>> loss.qvalue(data).shape, loss.qvalue(data, target=True).shape
        (torch.Size([2, 8]), torch.Size([2, 8]))
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename.

        Attributes:
            action: action of the data.
            state_action_value: the critics' output.
            reward: under ``"next"``.
            done: under ``"next"``.
            terminated: under ``"next"``; only this stops the bootstrap.
            priority: written to the input.
            priority_weight: read from the input where present.
        """

        action: NestedKey = "action"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

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
        reduction: str | None = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__(
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
        )
        if loss_function not in LOSS_FUNCTIONS:
            raise UnknownNameError("loss_function", loss_function, LOSS_FUNCTIONS)
        self._gamma = check_number("gamma", gamma, 0, 1)
        self._cold = False
        self.loss_function = loss_function
        self.separate_losses = separate_losses

    # -- construction ----------------------------------------------------------------------------

    def convert_critics(
        self,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        num_qvalue_nets: int | None,
        *,
        default: int = 2,
    ) -> None:
        """Takes over the critics and makes their targets; call it after all other networks.

        Args:
            qvalue_network: list of critics, each with an initialisation of its own, or one critic,
                which is then copied ``num_qvalue_nets`` times and initialised anew in each copy.
            num_qvalue_nets: number of critics; ``None`` for the length of the list, or ``default``.
            default: number of critics made from a single one.

        Raises:
            BMRLError: for no critics, a number that is not the list's length, a critic that cannot
                read the entries as the other networks do, or a single critic that cannot be
                initialised anew.
        """
        several = isinstance(qvalue_network, (Sequence, nn.ModuleList))
        for critic in qvalue_network if several else [qvalue_network]:
            check_network("a critic" if several else "qvalue_network", critic)
            self.check_sizes("qvalue_network", critic)
        if several:
            critics = list(qvalue_network)
            if not critics or num_qvalue_nets not in (None, len(critics)):
                raise BMRLError(
                    f"qvalue_network is a list of {len(critics)} critics and num_qvalue_nets is "
                    f"{num_qvalue_nets}; valid: at least one critic, and their number or None"
                )
        else:
            count = default if num_qvalue_nets is None else num_qvalue_nets
            count = check_number("num_qvalue_nets", count, 1, integer=True)
            taken = list(self.parameters())
            critics = [qvalue_network, *(_renewed(qvalue_network, taken) for _ in range(count - 1))]
        self.num_qvalue_nets = len(critics)
        self._flat_rows = any(
            isinstance(part, _BatchNorm) for critic in critics for part in critic.modules()
        )
        owners = [id(p) for critic in critics for p in critic.parameters()]
        known = {id(p) for p in self.parameters()}
        # Stacking makes new parameters and keeps one structure, so critics that differ, share
        # parameters with each other, another network or within themselves, or have no shapes yet,
        # stay apart; of a list of one, TorchRL would make no parameters at all.
        apart = any(map(is_lazy, critics)) or any(map(_has_tied_parameters, critics))
        alike = not apart and len({kind(critic) for critic in critics}) == 1
        self._stacked = (
            alike
            and len(critics) > 1
            and len(set(owners)) == len(owners)
            and known.isdisjoint(owners)
        )
        if self._stacked:
            for critic in critics:
                note_copied(critic, type(self).__name__)
            self.convert_to_functional(
                critics,
                "qvalue_network",
                expand_dim=len(critics),
                create_target_params=True,
            )
        else:
            self.convert_to_functional(
                _Ensemble(critics), "qvalue_network", create_target_params=True
            )

    def finish(self) -> None:
        """Ends a subclass's ``__init__``: the value estimator, and who shares parameters."""
        self.make_value_estimator(self.default_value_estimator)
        self.keep_keys()
        self._find_shared()

    def _parameters_changed(self) -> None:
        super()._parameters_changed()
        self._find_shared()

    def _find_shared(self) -> None:
        """Notes which parameters the networks share with the generator."""
        generator = self._modules.get("generator_params")
        own = set() if generator is None else {id(p) for p in generator.parameters()}
        self._shared_with_generator = {
            name: [
                key
                for key, value in params.items(include_nested=True, leaves_only=True)
                if name != "generator_params" and id(value) in own
            ]
            for name, params in self.named_children()
            if isinstance(params, TensorDictParams)
        }

    def check_sizes(self, name: str, network: Any) -> None:
        """Compares what a network reads and writes with the networks that the loss already has.

        Args:
            name: of the network, for the message.
            network: that is about to be taken over.

        Raises:
            BMRLError: if they do not fit together, see :func:`.checks.check_fit`.
        """
        others = [(key, x) for key, x in vars(self).items() if isinstance(x, nn.Module)]
        check_fit(name, network, agreed_sizes([*others, (name, network)]))
        self._cold = self._cold or is_lazy(network)

    def _warm_up(self, tensordict: TensorDictBase, batch: torch.Size) -> None:
        """Gives lazy networks their parameters, by the sizes of the first batch."""
        self._cold = False
        data = {key: tensordict.get(key, None) for key in self.in_keys}
        shapes = {key: x.shape[len(batch) :] for key, x in data.items() if x is not None}
        latent = getattr(vars(self).get("generator"), "latent_dim", None)
        if latent is not None:
            shapes[getattr(self.tensor_keys, "action_latent", "action_latent")] = (latent,)
        for name, network in vars(self).items():
            if isinstance(network, nn.Module) and is_lazy(network):
                for part in parts_of(network):
                    warm_up(name, part, shapes)

    def _reset_module_parameters(self, module_name: str, module: Any) -> None:
        """Initialises a network anew, each critic on its own, and copies it to its target."""
        params = getattr(self, f"{module_name}_params")
        stacked = module_name == "qvalue_network" and self._stacked
        for own in params.unbind(0) if stacked else [params]:
            fresh = deepcopy(module)
            fresh.reset_parameters_recursive()
            own.data.update_(TensorDict.from_module(fresh).data)
        target = self._modules.get(f"target_{module_name}_params")
        if target is not None:
            target.data.update_(params.data)

    def critic(self, index: int = 0) -> tuple[TensorDictModule, TensorDictBase]:
        """One critic: its module and the parameters that belong into it.

        Args:
            index: of the critic, below ``num_qvalue_nets``.
        """
        if self._stacked:
            return self.qvalue_network, self.qvalue_network_params[index]
        params = self.qvalue_network_params["critics", str(index)]
        return self.qvalue_network.critics[index], params

    def weights(
        self, name: str, *, target: bool = False, frozen: bool = False
    ) -> TensorDictBase | list[Tensor]:
        """Parameters of a network, to be put into it by :func:`holding`.

        Args:
            name: the network, such as ``"qvalue_network"``.
            target: those of its target.
            frozen: without a gradient into them. Otherwise they are as the network's own loss
                trains them, see ``separate_losses``.
        """
        attribute = f"target_{name}_params" if target else f"{name}_params"
        shared = self._shared_with_generator[attribute] if self.separate_losses else []
        params = getattr(self, attribute)
        if torch.compiler.is_compiling():
            if frozen:
                return params.detach()
            return without_gradient(params, shared) if shared else params
        module = getattr(self, name)
        if shared and not frozen:
            return leaves(without_gradient(params, shared), module)
        # Looked up at every call: the parameters may have been replaced since the last one.
        own = leaves(params, module)
        return [leaf.detach() for leaf in own] if frozen and torch.is_grad_enabled() else own

    def call(
        self, name: str, tensordict: TensorDictBase, *, target: bool = False, frozen: bool = False
    ) -> TensorDictBase:
        """Runs a network on data.

        Args:
            name: the network, such as ``"qvalue_network"``.
            tensordict: what it reads; what it writes is added.
            target: whether with its target's parameters.
            frozen: whether without a gradient into its parameters, see :meth:`weights`.

        Raises:
            BMRLError: if the data do not fit the network.
        """
        module = getattr(self, name)
        with holding(module, self.weights(name, target=target, frozen=frozen)):
            return read(module, tensordict)

    def evaluate(
        self,
        tensordict: TensorDictBase,
        key: NestedKey,
        *,
        target: bool = False,
        frozen: bool = False,
    ) -> Tensor:
        """One output of all critics, stacked in front.

        Args:
            tensordict: what they read, batch ``[*B]``.
            key: the output.
            target: whether with the targets' parameters.
            frozen: whether without a gradient into their parameters.

        Returns:
            ``(num_qvalue_nets, *B, n)``.

        Raises:
            BMRLError: if the data do not fit the critics, or these do not write the key.
        """
        network = self.qvalue_network
        inputs = tensordict.select(*network.in_keys)
        if self._flat_rows and inputs.ndim > 1:
            # A BatchNorm takes the second of more than two dimensions for its features.
            values = self.evaluate(inputs.reshape(-1), key, target=target, frozen=frozen)
            return values.unflatten(1, inputs.batch_size)
        if not self._stacked:
            values = self.call("qvalue_network", inputs, target=target, frozen=frozen)
            return output(values, key, network)
        if self.critics_in_sequence:
            weights = self.weights("qvalue_network", target=target, frozen=frozen)
            if isinstance(weights, list):
                each: Any = map(list, zip(*(leaf.unbind(0) for leaf in weights), strict=True))
            else:
                each = weights.unbind(0)
            outputs = []
            for own in each:
                with holding(network, own):
                    outputs.append(output(read(network, inputs.copy()), key, network))
            return torch.stack(outputs)
        # Made anew at every call: kept, it could not be pickled, and a copy of the loss would run
        # the original's network.
        run = _vmap_func(network, (None, 0), randomness=self.vmap_randomness)
        params = getattr(self, f"{'target_' if target else ''}qvalue_network_params")
        return output(run(inputs, params.detach() if frozen else params), key, network)

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
            target: whether with the targets' parameters.
            frozen: whether without a gradient into their parameters.

        Raises:
            BMRLError: if the critics' output is not ``(*B, 1)``.
        """
        key = self.tensor_keys.state_action_value
        value = self.evaluate(tensordict, key, target=target, frozen=frozen)
        if value.shape[-1] != 1:
            raise BMRLError(f"the critics' {key!r} has shape {tuple(value.shape)}; valid: (*B, 1)")
        return value.squeeze(-1)

    # -- keys ------------------------------------------------------------------------------------

    @property
    def outcome_keys(self) -> list[NestedKey]:
        """Where reward, done and terminated lie."""
        keys = self.tensor_keys
        return [next_key(key) for key in (keys.reward, keys.done, keys.terminated)]

    def _estimator_keys(self) -> dict[str, NestedKey]:
        keys = self.tensor_keys
        return {
            "value": keys.state_action_value,
            "reward": keys.reward,
            "done": keys.done,
            "terminated": keys.terminated,
        }

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._estimator_keys())
        super()._forward_value_estimator_keys()

    # -- target, priority, reduction -------------------------------------------------------------

    @property
    def gamma(self) -> float:
        """Discount of the value estimator; an assignment changes the estimator's."""
        held = getattr(self._value_estimator, "gamma", None)
        # The estimator's is of its own type, in which 0.99 is another number.
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
        value_type = value_type or self.default_value_estimator
        if isinstance(value_type, ValueEstimatorBase) or (
            isinstance(value_type, type) and issubclass(value_type, ValueEstimatorBase)
        ):
            LossModule.make_value_estimator(self, value_type, **hyperparams)
            self._forward_value_estimator_keys()
            self._gamma = float(getattr(self.value_estimator, "gamma", self._gamma))
            return self
        gamma = self.gamma
        estimator = dispatch_value_estimator(
            self,
            value_type,
            supported=self.SUPPORTED_VALUE_ESTIMATORS,
            tensor_keys=self._estimator_keys(),
            value_network=None,
            **hyperparams,
        )
        # TorchRL keeps hyper-parameters in float32; 0.99 is another number there.
        estimator.to(**self._type_and_device)
        exact = default_value_kwargs(self.value_type) | {"gamma": gamma} | hyperparams
        self._gamma = check_number("gamma", exact["gamma"], 0, 1)
        for name, value in exact.items():
            if name in dict(estimator.named_buffers()):
                estimator.get_buffer(name).fill_(value)
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
        for key in self.outcome_keys:
            value = entry(tensordict, key, valid)
            shape = value.shape
            if key != next_key(keys.reward) and value.dtype != torch.bool:
                raise BMRLError(f"{key!r} is {value.dtype}; valid: torch.bool")
            if shape != next_value.shape:
                raise BMRLError(
                    f"{key!r} has the shape {tuple(shape)}; valid: {tuple(next_value.shape)}, the "
                    "action's with a last dimension of one"
                )
            if valid is not None:
                if key == next_key(keys.done):
                    # A return must not go on from the last row that counts into the padding.
                    time = _time_dimension(tensordict, valid.ndim)
                    ahead = valid.narrow(time, 1, valid.shape[time] - 1)
                    last = valid.narrow(time, valid.shape[time] - 1, 1)
                    goes_on = torch.cat([ahead, last], time)
                    value = value | ~(valid & goes_on).unsqueeze(-1)
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
            ``target_value`` and ``next_state_value``. Rows that a mask leaves out have the error 0
            and count in no mean.
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
        """The shape ``*B`` of the data, told by the action; keyword calls have no batch size.

        Raises:
            BMRLError: if the data have no action, or no row, or a network reads an entry under a
                name that the loss no longer uses.
        """
        self.check_names()
        key = self.tensor_keys.action
        action = tensordict.get(key, None)
        if action is None:
            raise missing(tensordict, key, self.readers(key))
        if self._cold:
            self._warm_up(tensordict, action.shape[:-1])
        if not action.numel():
            raise BMRLError(f"{key!r} has the shape {tuple(action.shape)}; valid: one row at least")
        return action.shape[:-1]

    def rows(
        self, tensordict: TensorDictBase, keys: Iterable[NestedKey], *, after: bool = False
    ) -> TensorDictBase:
        """The entries of some keys, now or ``after`` the step, with the batch size ``*B``.

        Args:
            tensordict: the data.
            keys: of the entries, as networks read them.
            after: whether those under ``"next"``; they come back without that prefix.

        Raises:
            BMRLError: for a missing key, a number that is not finite, or another batch shape.
        """
        batch = self.batch_shape(tensordict)
        valid = self.valid_rows(tensordict, batch)
        values = {}
        for key in keys:
            full = next_key(key) if after else key
            values[key] = value = entry(tensordict, full, valid, self.readers)
            if value.shape[: len(batch)] != batch:
                raise BMRLError(
                    f"{full!r} has the shape {tuple(value.shape)}; valid: {tuple(batch)} and its "
                    "own dimensions, as the action has"
                )
        simple = valid is None and all(isinstance(key, str) for key in values)
        if simple and tensordict.batch_size == batch:
            return (tensordict.get("next") if after else tensordict).select(*values)
        # Made new: what a keyword call nests has a batch size of its own.
        result = TensorDict({}, batch_size=batch)
        for key, value in values.items():
            result.set(key, value)
        return result


def _time_dimension(tensordict: TensorDictBase, ndim: int) -> int:
    """Where the estimators take time to be: the dimension of that name, or the last one."""
    names = tensordict.names if tensordict.ndim == ndim else []
    return names.index("time") if "time" in names else ndim - 1


class _Ensemble(TensorDictModuleBase):
    """Critics that are run one after the other, their outputs stacked in front."""

    def __init__(self, critics: Sequence[TensorDictModule]) -> None:
        super().__init__()
        self.critics = nn.ModuleList(critics)
        self.in_keys = list(dict.fromkeys(key for critic in critics for key in critic.in_keys))
        self.out_keys = critics[0].out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return torch.stack([critic(tensordict.copy()) for critic in self.critics])


def _has_tied_parameters(module: nn.Module) -> bool:
    """Whether two places of a network hold one parameter."""
    names = list(module.named_parameters(remove_duplicate=False))
    return len(names) > len(list(module.parameters()))


def _renewed(module: TensorDictModule, shared: Sequence[nn.Parameter]) -> TensorDictModule:
    """A copy with an initialisation of its own, but for what it shares with another network."""
    copy = deepcopy(module, {id(parameter): parameter for parameter in shared})
    for name, part in copy.named_modules():
        own = [
            p
            for p in part.parameters(recurse=False)
            if p.requires_grad and not any(p is other for other in shared)
        ]
        if own and not hasattr(part, "reset_parameters"):
            raise BMRLError(
                f"the critic's part {name!r}, a {type(part).__name__}, has no reset_parameters() "
                "to initialise a copy with; valid: a list of critics, each initialised on its own"
            )
        if own:
            part.reset_parameters()
    return copy
