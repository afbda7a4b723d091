"""What the losses ask of their options and of the data."""

from __future__ import annotations

from math import isfinite

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_bmrl.errors import BMRLError


def check_lmbda(lmbda: float) -> float:
    """λ of the soft clipped double-Q.

    Raises:
        BMRLError: outside [0, 1].
    """
    if not 0.0 <= lmbda <= 1.0:
        raise BMRLError(f"lmbda is {lmbda}; valid: between 0 and 1")
    return lmbda


def check_value_bounds(bounds: tuple[float, float] | None) -> tuple[float, float] | None:
    """Bounds on a value, in order.

    Raises:
        BMRLError: if the lower one is not below the upper one.
    """
    if bounds is not None and not bounds[0] < bounds[1]:
        raise BMRLError(f"value_bounds are {bounds}; valid: (low, high) with low < high, or None")
    return bounds


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
    if torch.compiler.is_compiling() or value.device.type != "cpu":
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


def priority_weight(loss: LossModule, tensordict: TensorDictBase) -> Tensor | None:
    """Weights of the rows, also under a nested key, which TorchRL's own does not find."""
    if loss.use_prioritized_weights not in (True, "auto"):
        return None
    return tensordict.get(loss.tensor_keys.priority_weight, None)


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
    except RuntimeError as error:
        shapes = ", ".join(f"{key!r} {tuple(tensordict[key].shape)}" for key in module.in_keys)
        raise BMRLError(
            f"a network cannot read {shapes} ({error}); valid: the sizes that it was made for"
        ) from error
