"""Settings as dataclasses whose fields declare their valid values, and the check of them."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from operator import ge, gt, le
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from torchrl_bmrl.errors import ConfigError, UnknownNameError

_LIMITS = {"above": ("above", gt), "at_least": ("at least", ge), "at_most": ("at most", le)}


def setting(
    default: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    choices: Sequence[Any] = (),
    unique: bool = False,
) -> Any:
    """Declares a field of a settings dataclass and its valid values.

    The limits apply to each value of a list or mapping. ``None`` is valid where the type allows it.

    Args:
        default: the default; lists and dicts are copied for each object, a function is called.
        above: exclusive lower limit.
        at_least: lower limit.
        at_most: upper limit.
        choices: the valid values.
        unique: whether a list must not be empty and must contain each value once.

    Example:
        >>> @dataclasses.dataclass
        ... class Small:
        ...     lr: float = setting(1e-3, above=0)
        >>> check_settings(Small(lr=-1.0))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: lr is -1.0; valid: above 0
    """
    valid = {
        "above": above,
        "at_least": at_least,
        "at_most": at_most,
        "choices": tuple(choices),
        "unique": unique,
    }
    if isinstance(default, list | dict):
        default = default.copy
    if callable(default):
        return dataclasses.field(default_factory=default, metadata=valid)
    return dataclasses.field(default=default, metadata=valid)


def check_settings(settings: Any, prefix: str = "") -> None:
    """Checks every field of a settings dataclass and of the dataclasses in it.

    Args:
        settings: the object.
        prefix: prefix of the names in messages, such as ``"bcq."``.

    Raises:
        UnknownNameError: for a value that is none of the choices.
        ConfigError: naming the field, its value and the valid values.

    Example:
        >>> @dataclasses.dataclass
        ... class Small:
        ...     kind: str = setting("a", choices=("a", "b"))
        >>> check_settings(Small())
    """
    types = get_type_hints(type(settings))
    for field in dataclasses.fields(settings):
        name, value = f"{prefix}{field.name}", getattr(settings, field.name)
        _check_container(name, value, types[field.name])
        if dataclasses.is_dataclass(value):
            check_settings(value, f"{name}.")
        elif field.metadata:
            _check(name, value, field.metadata)


def _check_container(name: str, value: Any, kind: Any) -> None:
    """Checks that a list is one, and a mapping; a reference to another setting may give a number.

    Other types are left to the limits, to the choices and to Hydra.
    """
    if get_origin(kind) is UnionType:
        if value is None:
            return
        (kind,) = (each for each in get_args(kind) if each is not type(None))
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (list, tuple):
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{name} is {value!r}; valid: a list")
        for item in value:
            _check_container(name, item, arguments[0])
    elif origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{name} is {value!r}; valid: a mapping")
        for key, item in value.items():
            _check_container(f"{name}.{key}", item, arguments[1])


def _check(name: str, value: Any, valid: Mapping[str, Any]) -> None:
    if valid["unique"] and (not value or any(x in value[:i] for i, x in enumerate(value))):
        raise ConfigError(f"{name} is {value}; valid: at least one value, each once")
    limits = [(*_LIMITS[key], valid[key]) for key in _LIMITS if valid[key] is not None]
    for key, item in _items(name, value):
        if valid["choices"]:
            if item not in valid["choices"]:
                raise UnknownNameError(name, item, valid["choices"])
            continue
        # A reference to another setting may give a text.
        if item is not None and not (isinstance(item, int | float) and _is_within(item, limits)):
            text = " and ".join(f"{words} {limit:g}" for words, _, limit in limits)
            raise ConfigError(f"{key} is {item!r}; valid: {text}")


def _is_within(number: float, limits: Sequence[tuple[str, Any, float]]) -> bool:
    within = all(compare(number, limit) for _, compare, limit in limits)
    return within and (not limits or abs(number) <= sys.float_info.max)


def _items(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yields the values of a setting, each with its name."""
    if isinstance(value, Mapping):
        yield from ((f"{name}.{key}", item) for key, item in value.items())
    elif isinstance(value, list | tuple):
        yield from ((name, item) for item in value)
    else:
        yield name, value
