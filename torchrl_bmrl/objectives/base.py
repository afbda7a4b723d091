"""The part of a loss that does not depend on what it learns: keys, coefficients, reduction."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import asdict
from math import inf
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import unpadded
from torchrl_bmrl.objectives.checks import check_number, whole_signature
from torchrl_bmrl.objectives.data import entry, own_name
from torchrl_bmrl.objectives.sizes import agreed_sizes, check_fit, is_lazy, parts_of
from torchrl_bmrl.objectives.swap import Weights, holding, leaves, read, share_as, without_gradient

REDUCTIONS = ("mean", "sum", "none")
Self = TypeVar("Self", bound="KeyedLoss")


class KeyedLoss(LossModule):
    """Base of all losses: keys, coefficients, calls of the networks, and the reduction.

    A subclass lists the keys that it reads and writes (:meth:`read_keys`, :meth:`written_keys`)
    and calls :meth:`keep_keys` at the end of its ``__init__``. If its ``__init__`` takes
    ``**options`` for its base, ``inspect.signature`` of the class also shows the base's options.

    Keyword Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; ``None`` means ``"mean"``.
        deactivate_vmap: run ensembles in a loop instead of under :func:`torch.vmap`.
        use_prioritized_weights: ``True``, ``False`` or ``"auto"``, as in TorchRL's losses.

    Raises:
        UnknownNameError: for another ``reduction``.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> loss = BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> loss.set_keys(reward="points")
        >>> ("next", "points") in loss.in_keys, loss.out_keys[:2]
        (True, ['loss_generator', 'loss_qvalue'])
        >>> loss.lmbda = 0.5  # as a scheduler does; coefficients are buffers, so they are saved
        >>> loss.lmbda
        tensor(0.5000)
    """

    fixed_options: ClassVar[tuple[str, ...]] = ()
    """Options of the base that a subclass sets itself and does not accept."""
    frozen_networks: ClassVar[tuple[str, ...]] = ()
    """Networks that stay in evaluation mode, since this loss never trains them."""
    separate_losses = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            cls.__signature__ = whole_signature(cls, cls.fixed_options)

    def __init__(
        self,
        *,
        reduction: str | None = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__()
        reduction = "mean" if reduction is None else reduction
        if reduction not in REDUCTIONS:
            raise UnknownNameError("reduction", reduction, REDUCTIONS)
        self._coefficients: dict[str, tuple[float, float, bool]] = {}
        self._shared_with_generator: dict[str, list[NestedKey]] = {}
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[str] | None = None
        self._left_behind: str | None = None
        self._cold = False  # whether a network is lazy
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights

    # -- coefficients ----------------------------------------------------------------------------

    def register_coefficients(
        self, *, low: float = 0.0, high: float = inf, optional: bool = False, **values: Any
    ) -> None:
        """Registers hyper-parameters as buffers with the networks' dtype and device.

        A later assignment of a number, ``loss.lmbda = 0.5``, is checked and written to the buffer.

        Args:
            low: smallest valid value.
            high: largest valid value.
            optional: whether ``None`` is valid; then there is no buffer.
            **values: hyper-parameters by name.

        Raises:
            BMRLError: for a value out of range, or before the loss has a network.
        """
        if next(self.parameters(), None) is None:
            raise BMRLError(
                f"register_coefficients({', '.join(values)}) before the loss has a network; valid: "
                "after convert_to_functional, whose parameters give the dtype and device"
            )
        for name, value in values.items():
            value = check_number(name, value, low, high, optional=optional)
            self.__dict__["_coefficients"][name] = (low, high, optional)
            self.register_coeff_buffer(name, value, **self._type_and_device)

    @property
    def _type_and_device(self) -> dict[str, Any]:
        reference = next(self.parameters())
        return {"dtype": reference.dtype, "device": reference.device}

    def __setattr__(self, name: str, value: Any) -> None:
        limits = self.__dict__.get("_coefficients", {}).get(name)
        # A tensor with a gradient, or one per member under vmap, replaces the buffer.
        if limits is None or (
            isinstance(value, Tensor) and (value.requires_grad or value.numel() != 1)
        ):
            super().__setattr__(name, value)
            if name.endswith("_params") and self.__dict__.get("_out_keys") is not None:
                self._parameters_changed()
            return
        low, high, optional = limits
        value = check_number(name, value, low, high, optional=optional)
        buffer = self._buffers.get(name)
        if value is not None and buffer is not None:
            buffer.fill_(value)
            return
        self.__dict__.pop(name, None)
        self._buffers.pop(name, None)
        if value is None:
            self.__dict__[name] = None
        else:
            self.register_coeff_buffer(name, value, **self._type_and_device)
        self._parameters_changed()

    # -- copies, and policies that share the parameters ------------------------------------------

    def _parameters_changed(self) -> None:
        """Updates live policies when parameters are replaced or coefficients come or go."""
        for policy in self.__dict__.get("_followers", ()):
            policy.follow()

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._apply(*args, **kwargs)
        self._parameters_changed()
        return result

    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Loads a state as :class:`torch.nn.Module` does, and updates live policies."""
        result = super().load_state_dict(*args, **kwargs)
        self._parameters_changed()
        return result

    def _reset_module_parameters(self, module_name: str, module: Any) -> None:
        """Initialises a network anew, each critic on its own, and copies it to its target."""
        params = getattr(self, f"{module_name}_params")
        for own in params.unbind(0) if params.batch_size else [params]:
            fresh = deepcopy(module)
            fresh.reset_parameters_recursive()
            own.data.update_(TensorDict.from_module(fresh).data)
        target = self._modules.get(f"target_{module_name}_params")
        if target is not None:
            target.data.update_(params.data)

    def __getstate__(self) -> dict[str, Any]:  # policies follow this loss, not its copies
        return {key: value for key, value in self.__dict__.items() if key != "_followers"}

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        copy = type(self).__new__(type(self))
        memo[id(self)] = copy
        copy.__dict__.update(deepcopy(self.__getstate__(), memo))
        share_as(self, copy)
        return copy

    # -- keys ------------------------------------------------------------------------------------

    def keep_keys(self) -> None:
        """Ends the construction: computes the keys now instead of at the first call.

        Otherwise a compiled loss would compile a second time.
        """
        self.set_vmap_randomness(self.vmap_randomness)
        self._in_keys, self._out_keys = self.in_keys, self.out_keys

    def _make_vmap(self) -> None:
        """Does nothing: no vmapped function is cached that a new randomness would change."""

    def read_keys(self) -> Iterable[NestedKey]:
        """Keys that the loss reads, in a stable order; duplicates are dropped."""
        raise NotImplementedError(
            f"{type(self).__name__} has no read_keys(); valid: a method that returns the keys that "
            "the loss reads, such as ['observation', 'action', ('next', 'reward')]"
        )

    def written_keys(self) -> list[str]:
        """Keys that ``forward`` returns, in order."""
        raise NotImplementedError(
            f"{type(self).__name__} has no written_keys(); valid: a method that returns the keys "
            "that forward() returns, in its order; of an OfflineLoss 'terms' such as ('qvalue',)"
        )

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the input, in a stable order."""
        if self._in_keys is None:
            self._in_keys = list(dict.fromkeys(self.read_keys()))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[str]:
        """Keys of the output, in the order in which a keyword call returns them."""
        if self._out_keys is None:
            self._out_keys = self.written_keys()
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[str]) -> None:
        self._out_keys = values

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        self._in_keys = None
        if self._out_keys is not None:  # construction is over
            self._in_keys = self.in_keys

    def set_keys(self, **kwargs: Any) -> None:
        """Renames entries; the networks keep their own names, which the next call compares.

        Args:
            **kwargs: new names of ``tensor_keys``; ``None`` for the default.
        """
        super().set_keys(**kwargs)
        self._left_behind = None
        for name, default in asdict(self.default_keys()).items():
            now = getattr(self.tensor_keys, name)
            behind = self.readers(default) if now != default else []
            if behind:
                self._left_behind = (
                    f"set_keys({name}={now!r}) renames what {' and '.join(behind)} read as "
                    f"{default!r}; valid: networks that read {now!r}, or {name}={default!r}"
                )

    def check_names(self) -> None:
        """Checks that no network reads an entry under a name that ``set_keys`` has replaced.

        Raises:
            BMRLError: naming the network.
        """
        if self._left_behind is not None:
            raise BMRLError(self._left_behind)

    def readers(self, key: NestedKey) -> list[str]:
        """Names of the networks that read a key, here, under ``"next"`` or in a context.

        Args:
            key: of an entry.
        """
        key = own_name(key)
        return [
            name
            for name, network in self._networks.items()
            if any(key in map(own_name, getattr(x, "in_keys", ())) for x in parts_of(network))
        ]

    # -- networks ---------------------------------------------------------------------------------

    @property
    def _networks(self) -> dict[str, nn.Module]:  # TorchRL keeps them outside of a loss's modules
        return {name: x for name, x in vars(self).items() if isinstance(x, nn.Module)}

    def train(self: Self, mode: bool = True) -> Self:
        """Sets the mode of this loss and of its networks, for example of their dropout.

        Args:
            mode: training, or evaluation.
        """
        super().train(mode)
        for name, network in self._networks.items():
            network.train(mode and name not in self.frozen_networks)
        return self

    def check_sizes(self, name: str, network: Any) -> None:
        """Compares a new network's sizes with those of the networks that the loss already has.

        Args:
            name: of the network, for the message.
            network: the network.

        Raises:
            BMRLError: if they do not fit together.
        """
        check_fit(name, network, agreed_sizes([*self._networks.items(), (name, network)]))
        self._cold = self._cold or is_lazy(network)

    def weights(self, name: str, *, target: bool = False, frozen: bool = False) -> Weights:
        """Parameters of a network, to be used inside :func:`.swap.holding`.

        Args:
            name: the network, such as ``"qvalue_network"``.
            target: whether to return those of its target network.
            frozen: whether they receive no gradient. Otherwise they receive the gradients that
                the network's own loss sends, see ``separate_losses``.
        """
        attribute = f"target_{name}_params" if target else f"{name}_params"
        shared = self._shared_with_generator.get(attribute, []) if self.separate_losses else []
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
            tensordict: what it reads; its output is added.
            target: whether the target network runs.
            frozen: whether its parameters receive no gradient, see :meth:`weights`.

        Raises:
            BMRLError: if the data do not fit the network.
        """
        module = getattr(self, name)
        with holding(module, self.weights(name, target=target, frozen=frozen)):
            return read(module, tensordict)

    # -- reduction -------------------------------------------------------------------------------

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        # TorchRL's own method does not find a nested key.
        if self.use_prioritized_weights not in (True, "auto"):
            return None
        return tensordict.get(self.tensor_keys.priority_weight, None)

    def valid_rows(self, tensordict: TensorDictBase, batch: torch.Size) -> Tensor | None:
        """Mask of the rows that count (``loss_mask_key``), or ``None`` if all do.

        Args:
            tensordict: the data.
            batch: shape of the rows, ``*B``.

        Returns:
            boolean, ``(*B,)``.

        Raises:
            BMRLError: for a mask of another type.
        """
        valid = None
        present = tensordict.keys()
        for key in self._loss_mask_keys():
            if (key if isinstance(key, str) else key[0]) not in present:
                continue  # a nested look-up costs more
            mask = tensordict.get(key, None)
            if mask is not None:
                if mask.dtype != torch.bool:
                    raise BMRLError(f"the mask {key!r} is {mask.dtype}; valid: torch.bool")
                mask = self._expand_loss_mask(mask, mask.new_zeros(()).expand(batch))
                valid = mask if valid is None else valid & mask
        return valid

    def reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Reduces a loss with the data's masks and priority weights.

        Args:
            loss: of each row, ``(*B,)``.
            tensordict: the data.

        Returns:
            ``()``; with ``reduction="none"`` ``(*B,)``, 0 for the rows that do not count.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        if weights is not None:
            valid = self.valid_rows(tensordict, loss.shape)
            weights = entry(tensordict, self.tensor_keys.priority_weight, valid)
            weights = weights.reshape(loss.shape)
            if valid is not None and self.reduction == "mean":
                # As in TorchRL, but 0 where no row counts.
                loss, total = unpadded(loss, valid), weights.sum()
                return (loss * weights).sum() / torch.where(total == 0, 1.0, total)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)
