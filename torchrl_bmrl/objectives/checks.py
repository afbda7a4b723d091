"""Checks of a loss's options."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from math import inf
from numbers import Integral, Real
from typing import Any

from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Composite

from torchrl_bmrl.errors import BMRLError, UnknownNameError


def whole_signature(cls: type, without: Sequence[str] = ()) -> inspect.Signature:
    """Signature of a class, with its base's keyword options in place of ``**options``.

    Args:
        cls: whose ``__init__`` passes ``**options`` on to its base.
        without: options of the base that the class does not accept.
    """
    own = inspect.signature(cls.__init__)  # type: ignore[misc]
    _, *parameters = own.parameters.values()
    if parameters and parameters[-1].kind is inspect.Parameter.VAR_KEYWORD:
        above = next(base for base in cls.__mro__[1:] if "__init__" in vars(base))
        parameters[-1:] = [
            x
            for x in inspect.signature(above).parameters.values()
            if x.kind is x.KEYWORD_ONLY and x.name not in (*own.parameters, *without)
        ]
    return own.replace(parameters=parameters)


def check_choice(name: str, value: Any, choices: Sequence[str]) -> Any:
    """An option that is one of some names.

    Args:
        name: the option, for the message.
        value: what was given.
        choices: the valid names.

    Raises:
        UnknownNameError: for another name.
    """
    if value not in choices:
        raise UnknownNameError(name, value, choices)
    return value


def check_number(
    name: str,
    value: Any,
    low: float = 0.0,
    high: float = inf,
    *,
    integer: bool = False,
    optional: bool = False,
) -> Any:
    """An option that is a number, as a Python number.

    Args:
        name: the option, for the message.
        value: a Python or numpy number, or a tensor with one number.
        low: smallest valid value.
        high: largest valid value.
        integer: whether it must be an integer.
        optional: whether ``None`` is valid.

    Raises:
        BMRLError: for anything else.
    """
    if value is None and optional:
        return value
    given = value
    if isinstance(value, Tensor) and value.numel() == 1:
        value = value.item()
    number = isinstance(value, Integral if integer else Real) and not isinstance(value, bool)
    if not number or not low <= value <= high:
        span = f"between {low:g} and {high:g}" if high < inf else f"at least {low:g}"
        raise BMRLError(
            f"{name} is {given!r}; valid: {span}{', an integer' * integer}{', or None' * optional}"
        )
    return int(value) if isinstance(value, Integral) else float(value)


def check_value_bounds(bounds: tuple[float, float] | None) -> tuple[float, float] | None:
    """Bounds on a value, in order.

    Raises:
        BMRLError: if the lower one is not below the upper one.
    """
    if bounds is None:
        return None
    try:
        low, high = map(float, bounds)
    except (TypeError, ValueError):
        low = high = inf
    if not low < high:
        raise BMRLError(f"value_bounds are {bounds}; valid: (low, high) with low < high, or None")
    return low, high


def check_network(name: str, network: Any) -> None:
    """Checks that a network has keys.

    Raises:
        BMRLError: for anything but a TensorDictModule.
    """
    if not isinstance(network, TensorDictModuleBase):
        raise BMRLError(
            f"{name} is a {type(network).__name__}; valid: a TensorDictModule, which knows the "
            "keys that it reads and writes"
        )


def leaf_of(spec: Any, key: NestedKey) -> Any:
    """The spec of one entry: itself, or in a composite spec that entry or the only one.

    Args:
        spec: of the action.
        key: of the entry in a composite spec.

    Raises:
        BMRLError: for a composite spec with several entries, none of them under the key.
    """
    if not isinstance(spec, Composite):
        return spec
    keys = list(spec.keys(include_nested=True, leaves_only=True))
    if key in keys:
        return spec[key]
    if len(keys) != 1:
        raise BMRLError(f"the spec has {keys}, not {key!r}; valid: the spec of the action alone")
    return spec[keys[0]]
