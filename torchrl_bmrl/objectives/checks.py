"""What the losses ask of their options and of the data."""

from __future__ import annotations

from math import inf, isfinite
from typing import Any

import torch
from tensordict import TensorDictBase, is_batchedtensor
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError


def check_number(
    name: str,
    value: Any,
    low: float = 0.0,
    high: float = inf,
    *,
    integer: bool = False,
    optional: bool = False,
) -> Any:
    """An option that is a number.

    Args:
        name: the option, for the message.
        value: what was given.
        low: smallest valid value.
        high: largest valid value.
        integer: whether it must be an integer.
        optional: whether ``None`` is valid.

    Raises:
        BMRLError: for anything else.

    Example:
        >>> check_number("lmbda", 0.75, 0.0, 1.0)
        0.75
    """
    if value is None and optional:
        return value
    kind = (int,) if integer else (int, float)
    number = isinstance(value, kind) and not isinstance(value, bool)
    if not number or not low <= value <= high:
        span = f"between {low:g} and {high:g}" if high < inf else f"at least {low:g}"
        raise BMRLError(
            f"{name} is {value!r}; valid: {span}{', an integer' * integer}{', or None' * optional}"
        )
    return value


def check_value_bounds(bounds: tuple[float, float] | None) -> tuple[float, float] | None:
    """Bounds on a value, in order.

    Raises:
        BMRLError: if the lower one is not below the upper one.
    """
    if bounds is None:
        return None
    if not isinstance(bounds, (list, tuple)) or len(bounds) != 2 or not bounds[0] < bounds[1]:
        raise BMRLError(f"value_bounds are {bounds}; valid: (low, high) with low < high, or None")
    return bounds[0], bounds[1]


def check_network(name: str, network: Any) -> None:
    """A network with keys.

    Raises:
        BMRLError: for anything but a TensorDictModule.
    """
    if not isinstance(network, TensorDictModuleBase):
        raise BMRLError(
            f"{name} is a {type(network).__name__}; valid: a TensorDictModule, which knows the "
            "keys that it reads and writes"
        )


def output(tensordict: TensorDictBase, key: NestedKey, network: TensorDictModule) -> Tensor:
    """What a network wrote.

    Raises:
        BMRLError: if it writes other keys.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise BMRLError(
            f"a network writes {list(network.out_keys)}, not {key!r}; valid: a network that writes "
            f"it, or another name for it in set_keys()"
        )
    return value


def check_same_shape(key: NestedKey, value: Tensor, expected: Tensor) -> None:
    """Refuses what would be broadcast in silence.

    Raises:
        BMRLError: naming the key and both shapes.
    """
    if value.shape != expected.shape:
        raise BMRLError(
            f"{key!r} has the shape {tuple(value.shape)}; valid: {tuple(expected.shape)}, as the "
            "networks have it"
        )


def check_index(key: NestedKey, index: Tensor, count: int) -> None:
    """Indices of a class; in a compiled loss or on another device than CPU only their type.

    Raises:
        BMRLError: for numbers that are not integers, or out of range.
    """
    if index.is_floating_point() or index.is_complex() or index.dtype == torch.bool:
        raise BMRLError(f"{key!r} is {index.dtype}; valid: torch.int64")
    if not readable(index) or not index.numel():
        return
    low, high = int(index.min()), int(index.max())
    if low < 0 or high >= count:
        raise BMRLError(f"{key!r} holds {low if low < 0 else high}; valid: 0 to {count - 1}")


def readable(value: Tensor) -> bool:
    """Whether Python may look at the numbers: on CPU, neither compiled nor under vmap."""
    return not (
        torch.compiler.is_compiling() or value.device.type != "cpu" or is_batchedtensor(value)
    )


def next_key(key: NestedKey) -> tuple[str, ...]:
    """The key under ``"next"``.

    Example:
        >>> next_key("reward"), next_key(("agent", "reward"))
        (('next', 'reward'), ('next', 'agent', 'reward'))
    """
    return ("next", key) if isinstance(key, str) else ("next", *key)


def entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """One entry of the data, finite.

    On CPU a number that is not finite is refused; elsewhere that would wait for the device, and
    in a compiled loss it cannot be said.

    Raises:
        BMRLError: if it is missing, or holds NaN or infinity.

    Example:
        >>> from tensordict import TensorDict
        >>> entry(TensorDict({"reward": torch.tensor([1.0])}, []), "reward")
        tensor([1.])
    """
    value = tensordict.get(key, None)
    if value is None:
        raise missing(tensordict, key)
    if not readable(value):
        return value
    # The sum is cheap and tells all but what only adds up to infinity.
    if value.is_floating_point() and not isfinite(value.sum().item()):
        finite = value.isfinite()
        if not finite.all():
            first = tuple((~finite).nonzero()[0].tolist())
            raise BMRLError(
                f"{key!r} holds {int((~finite).sum())} numbers that are not finite, the first, "
                f"{value[first].item()}, at {first}; valid: finite numbers"
            )
    return value


def missing(tensordict: TensorDictBase, key: NestedKey) -> BMRLError:
    """The error for an entry that the data lack."""
    present = [str(key) for key in tensordict.keys(include_nested=True, leaves_only=True)]
    return BMRLError(f"the data have no {key!r}; they have: {', '.join(present) or 'nothing'}")


def read(module: TensorDictModule, tensordict: TensorDictBase) -> TensorDictBase:
    """Runs a network on the data.

    Raises:
        BMRLError: naming what it reads, with the shapes, if they do not fit it.
    """
    if torch.compiler.is_compiling():
        return module(tensordict)
    try:
        return module(tensordict)
    except torch.OutOfMemoryError:
        raise
    except (RuntimeError, KeyError) as error:
        entries = ((key, tensordict.get(key, None)) for key in module.in_keys)
        seen = ", ".join(
            f"{key!r} {'missing' if x is None else f'{tuple(x.shape)} {x.dtype}'}"
            for key, x in entries
        )
        raise BMRLError(
            f"a network cannot read {seen} ({error}); valid: the sizes and types that it was "
            "made for"
        ) from error
