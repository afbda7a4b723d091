"""Options for reading demonstrations, shared by loading, checking and converting."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import reduce
from typing import Any, Literal, get_args

import numpy as np

from torchrl_bmrl.errors import ConfigError, UnknownNameError

LastStep = Literal["drop", "truncate", "terminate"]
Reward = Literal["success", "last"]
Bounds = tuple[float | Sequence[float], float | Sequence[float]]
"""Lowest and highest action: a number each, or one for each dimension."""


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Choices that a reader makes if a file leaves something open.

    Attributes:
        split: name of a mask, such as ``"train"``; ``None`` for all episodes.
        observation_keys: parts of the observation to read; ``None`` for all.
        dones_terminate: whether ``dones`` at an episode's last step is a termination, in files
            without ``terminated``. The default is ``False``, because the simulators of these files
            do not terminate, and the value after a horizon is not 0.
        last_step: treatment of an episode's last step if no observation after it was recorded.
            ``"drop"`` leaves it out, with its reward and success. ``"truncate"`` and
            ``"terminate"`` keep it and use its own observation as the next one; after
            ``"truncate"`` the value is bootstrapped from there, after ``"terminate"`` it is 0.
            ``None`` is ``"drop"``, but refuses a data set that would lose all of its reward, or all
            of its successes. A step that terminates is always kept.
        reward: source of the rewards; ``None`` for the file. ``"success"``: 1 at each step that
            ``successes`` marks or, in files with only an attribute ``success``, at the last step of
            each successful episode, and else 0. ``"last"``: 1 at every episode's last step.
        successful: whether to leave out the episodes that did not succeed.
        bounds: lowest and highest floating-point action. ``None`` for those that the file states,
            or else [-1, 1]; ``"data"`` for each dimension's smallest and largest action.
        horizon: number of steps of the longest episode, for D4RL's files without ``timeouts``.

    Raises:
        ConfigError: for invalid values.

    Example:
        >>> ReadOptions(last_step="keep")
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: last_step is 'keep'; valid: drop, truncate, terminate, None
    """

    split: str | None = None
    observation_keys: Iterable[str] | None = None
    dones_terminate: bool = False
    last_step: LastStep | None = None
    reward: Reward | None = None
    successful: bool = False
    bounds: Bounds | Literal["data"] | None = None
    horizon: int | None = None

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any] | None) -> ReadOptions:
        """Options from a plain mapping, such as a section of a YAML file.

        Args:
            mapping: values by the options' names; ``None`` for the defaults.

        Raises:
            ConfigError: for anything else than a mapping, and for invalid values.
            UnknownNameError: for a key that is not an option.

        Example:
            >>> ReadOptions.from_mapping({"reward": "success", "bounds": [-2, 2]}).bounds
            (-2.0, 2.0)
        """
        if mapping is None:
            return cls()
        if not isinstance(mapping, Mapping):
            raise ConfigError(f"the options are {mapping!r}; valid: a mapping of names to values")
        valid = [field.name for field in fields(cls)]
        for key in mapping:
            if key not in valid:
                raise UnknownNameError("option", key, valid)
        return cls(**mapping)

    def __post_init__(self) -> None:
        keys = self.observation_keys
        if not isinstance(self.split, str | None):
            raise ConfigError(f"split is {self.split!r}; valid: the name of a mask, or None")
        if isinstance(keys, str) or not isinstance(keys, Iterable | None):
            raise ConfigError(f"observation_keys is {keys!r}; valid: a list of names")
        if keys is not None:
            # Each name once, in order.
            names = tuple(dict.fromkeys(keys))
            if wrong := [key for key in names if not isinstance(key, str)]:
                raise ConfigError(f"observation_keys has {wrong[0]!r}; valid: names")
            object.__setattr__(self, "observation_keys", names)
        for name in ("dones_terminate", "successful"):
            value = getattr(self, name)
            if not isinstance(value, bool | np.bool_):
                raise ConfigError(f"{name} is {value!r}; valid: True, False")
            object.__setattr__(self, name, bool(value))
        for name, kind in (("last_step", LastStep), ("reward", Reward)):
            value, valid = getattr(self, name), get_args(kind)
            if value is not None and not (isinstance(value, str) and value in valid):
                raise ConfigError(f"{name} is {value!r}; valid: {', '.join(valid)}, None")
        bounds: Any = self.bounds
        # isinstance first: an array would be compared with "data" element by element.
        if bounds is not None and not (isinstance(bounds, str) and bounds == "data"):
            object.__setattr__(self, "bounds", check_bounds(bounds))


def check_bounds(bounds: Bounds, name: str = "bounds") -> Bounds:
    """Returns the lowest and the highest action as floats or tuples of floats.

    Raises:
        ConfigError: for other values, and if the lowest is not below the highest.
    """
    try:
        low, high = (np.asarray(bound, dtype=float) for bound in bounds)
        ordered = bool(np.all(low < high)) and max(low.ndim, high.ndim) < 2
    except (OverflowError, TypeError, ValueError):  # such as a number of hundreds of digits
        ordered = False
    if not ordered or not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ConfigError(
            f"{name} is {reprlib.repr(bounds)}; valid: two finite numbers, the lower first, or a "
            "list of one for each dimension in place of either"
        )
    return _plain(low), _plain(high)


def join_bounds(bounds: Sequence[Bounds]) -> Bounds:
    """The narrowest bounds that contain all of the given ones.

    Args:
        bounds: at least one.

    Raises:
        ConfigError: if they have different numbers of dimensions.

    Example:
        >>> join_bounds([(-1.0, 1.0), ((-2.0, 0.0), (0.5, 0.5))])
        ((-2.0, -1.0), (1.0, 1.0))
    """
    arrays: list[list[Any]] = [[np.asarray(end, dtype=float) for end in pair] for pair in bounds]
    try:
        low = reduce(np.minimum, [low for low, _ in arrays])
        high = reduce(np.maximum, [high for _, high in arrays])
    except ValueError as error:
        sizes = sorted({end.size for pair in arrays for end in pair if end.ndim})
        message = f"the actions' bounds have {sizes} dimensions; valid: equally many"
        raise ConfigError(message) from error
    return check_bounds((low, high))


def _plain(bound: np.ndarray) -> float | tuple[float, ...]:
    return tuple(bound.tolist()) if bound.ndim else float(bound)
