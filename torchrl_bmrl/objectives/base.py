"""The part of TorchRL's contract that does not depend on what a loss learns."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import asdict
from math import inf
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.objectives.checks import check_number, entry, parts_of

REDUCTIONS = ("mean", "sum", "none")


class KeyedLoss(LossModule):
    """Base of all losses here: keys that are read and written, coefficients, and the reduction.

    A subclass says what it reads and writes (:meth:`read_keys`, :meth:`written_keys`) and ends its
    construction with :meth:`keep_keys`.

    Keyword Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; ``None`` is ``"mean"``.
        deactivate_vmap: run ensembles in a loop and not under :func:`torch.vmap`.
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
        >>> loss.lmbda = 0.5  # as a scheduler does it; a buffer, so that it is saved
        >>> loss.lmbda
        tensor(0.5000)
    """

    def __init__(
        self,
        *,
        reduction: str | None = None,
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__()
        reduction = "mean" if reduction is None else reduction
        if reduction not in REDUCTIONS:
            raise UnknownNameError("reduction", reduction, REDUCTIONS)
        self._coefficients: dict[str, tuple[float, float, bool]] = {}
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[str] | None = None
        self._left_behind: str | None = None
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights

    # -- coefficients ----------------------------------------------------------------------------

    def register_coefficients(
        self, *, low: float = 0.0, high: float = inf, optional: bool = False, **values: Any
    ) -> None:
        """Makes hyper-parameters buffers of the networks' type and device.

        A later assignment of a number, ``loss.lmbda = 0.5``, is checked and goes to the buffer.

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
                "after convert_to_functional, whose parameters say the type and device"
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
        # A tensor with a gradient, or of members under vmap, takes the buffer's place.
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

    # -- those who hold the parameters -----------------------------------------------------------

    def _parameters_changed(self) -> None:
        """Tells live policies that parameters lie elsewhere, or coefficients have come or gone."""
        for policy in self.__dict__.get("_followers", ()):
            policy.follow()

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._apply(*args, **kwargs)
        self._parameters_changed()
        return result

    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Loads a state as :class:`torch.nn.Module` does; live policies follow."""
        result = super().load_state_dict(*args, **kwargs)
        self._parameters_changed()
        return result

    def __getstate__(self) -> dict[str, Any]:
        # Policies follow this loss, not its copies.
        return {key: value for key, value in self.__dict__.items() if key != "_followers"}

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        copy = type(self).__new__(type(self))
        memo[id(self)] = copy
        copy.__dict__.update(deepcopy(self.__getstate__(), memo))
        # TensorDictParams copies its parameters on its own, and so unties what two networks share.
        places: dict[int, list[tuple[str, NestedKey]]] = {}
        for name, params in self.named_children():
            if isinstance(params, TensorDictParams):
                for key, leaf in params._param_td.items(True, True):
                    places.setdefault(id(leaf), []).append((name, key))
        for (first, key), *others in places.values():
            for name, other in others:
                held = copy._modules[name]
                with held._param_td.unlock_():
                    held._param_td.set(other, copy._modules[first]._param_td.get(key))
                held._reset_params()
        return copy

    # -- keys ------------------------------------------------------------------------------------

    def keep_keys(self) -> None:
        """Ends the construction: what would be found at the first call is found now.

        Found then, a compiled loss would compile a second time.
        """
        self.set_vmap_randomness(self.vmap_randomness)
        self._in_keys, self._out_keys = self.in_keys, self.out_keys

    def _make_vmap(self) -> None:
        """Nothing is cached that ``set_vmap_randomness`` would have to renew."""

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
            "that forward() returns, in its order, such as ['loss_qvalue', 'td_error']"
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
        """Keys of the output, in the order of keyword dispatch."""
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
        """Renames entries; a network's own names stay, and are compared at the next call.

        Args:
            **kwargs: names of ``tensor_keys``; ``None`` for the default.
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
        """Refuses a network that reads an entry under a name that the loss no longer uses.

        Raises:
            BMRLError: naming the network.
        """
        if self._left_behind is not None:
            raise BMRLError(self._left_behind)

    def readers(self, key: NestedKey) -> list[str]:
        """Names of the networks that read a key, now or after the step.

        Args:
            key: of an entry.
        """
        if isinstance(key, tuple) and key[0] == "next":
            key = unravel_key(key[1:])
        networks = [(name, x) for name, x in vars(self).items() if isinstance(x, nn.Module)]
        return [
            name
            for name, network in networks
            if any(key in getattr(part, "in_keys", ()) for part in parts_of(network))
        ]

    # -- reduction -------------------------------------------------------------------------------

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        # TorchRL's own does not find a nested key.
        if self.use_prioritized_weights not in (True, "auto"):
            return None
        return tensordict.get(self.tensor_keys.priority_weight, None)

    def valid_rows(self, tensordict: TensorDictBase, batch: torch.Size) -> Tensor | None:
        """Which rows count by the data's masks (``loss_mask_key``); ``None`` if all do.

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
                # As TorchRL, and 0 where no row counts.
                loss, total = unpadded(loss, valid), weights.sum()
                return (loss * weights).sum() / torch.where(total == 0, 1.0, total)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)


def unpadded(value: Tensor, valid: Tensor | None) -> Tensor:
    """A number of each row, 0 for the rows that do not count.

    Args:
        value: ``(..., *B)``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Example:
        >>> unpadded(torch.tensor([1.0, torch.nan]), torch.tensor([True, False]))
        tensor([1., 0.])
    """
    return value if valid is None else torch.where(valid, value, torch.zeros_like(value))


def average(value: Tensor, valid: Tensor | None) -> Tensor:
    """Mean of a metric over the rows that count, detached.

    Args:
        value: ``(..., *B)``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Example:
        >>> average(torch.tensor([1.0, 7.0]), torch.tensor([True, False]))
        tensor(1.)
    """
    value = value.detach()
    if valid is None:
        return value.mean()
    number = valid.sum().clamp(min=1) * (value.numel() // valid.numel())
    return unpadded(value, valid).sum() / number
