"""Running a module with other parameters than its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

_PATHS: WeakKeyDictionary[nn.Module, list[tuple[str, ...]]] = WeakKeyDictionary()
_SLOTS: WeakKeyDictionary[nn.Module, list[tuple[dict[str, Tensor], str]]] = WeakKeyDictionary()


@contextmanager
def holding(module: nn.Module, params: TensorDictBase | list[Tensor]) -> Iterator[None]:
    """Puts parameters and buffers into a module for a while.

    It is ``params.to_module(module)`` without the bookkeeping that makes a tenth of a small update
    in eager mode; a compiled loss uses tensordict's own.

    Args:
        module: the module.
        params: in the layout of ``TensorDict.from_module(module)``, or in eager mode its
            :func:`leaves`.

    Example:
        >>> module = nn.Linear(1, 1)
        >>> with holding(module, TensorDict.from_module(module).data * 0):
        ...     module(torch.ones(1)).abs()
        tensor([0.])
        >>> isinstance(module.weight, nn.Parameter)
        True
    """
    if torch.compiler.is_compiling():
        assert not isinstance(params, list)
        with params.to_module(module, preserve_module_state=False):
            yield
        return
    slots = _slots(module)
    own = [owner[name] for owner, name in slots]
    _fill(slots, params if isinstance(params, list) else leaves(params, module))
    try:
        yield
    finally:
        _fill(slots, own)


def leaves(params: TensorDictBase, module: nn.Module) -> list[Tensor]:
    """Parameters and buffers in the order of a module's own.

    Args:
        params: in the layout of ``TensorDict.from_module(module)``.
        module: into which they belong.
    """
    # TensorDictParams wraps each of its own methods; what it holds does not.
    params = getattr(params, "_param_td", params)
    found = []
    for path in _paths(module):
        value: Any = params
        for part in path:
            # Where a plain TensorDict keeps it, which get() takes long for.
            held = getattr(value, "_tensordict", None)
            value = value.get(part) if held is None else held[part]
        found.append(value)
    return found


def without_gradient(params: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """The parameters, some of them detached."""
    copy = TensorDict(params.flatten_keys(".").to_dict()).unflatten_keys(".")
    return copy.update({key: params[key].detach() for key in keys})


def _fill(slots: Sequence[tuple[dict[str, Tensor], str]], values: Sequence[Tensor]) -> None:
    for (owner, name), value in zip(slots, values, strict=True):
        owner[name] = value


def _paths(module: nn.Module) -> list[tuple[str, ...]]:
    """Where a module's parameters and buffers lie in its tensordict."""
    _slots(module)
    return _PATHS[module]


def _slots(module: nn.Module) -> list[tuple[dict[str, Tensor], str]]:
    """Where a module keeps its parameters and buffers, in the order of its tensordict."""
    known = _SLOTS.get(module)
    if known is None:
        known, paths = [], []
        for key in TensorDict.from_module(module).keys(include_nested=True, leaves_only=True):
            path = (key,) if isinstance(key, str) else key
            owner = module.get_submodule(".".join(path[:-1]))
            place = owner._parameters if path[-1] in owner._parameters else owner._buffers
            known.append((cast("dict[str, Tensor]", place), path[-1]))
            paths.append(path)
        _SLOTS[module], _PATHS[module] = known, paths
    return known
