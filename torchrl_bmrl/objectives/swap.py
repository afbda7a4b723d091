"""Running networks with parameters that are not their own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias, cast
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_bmrl.errors import BMRLError

Weights: TypeAlias = TensorDictBase | list[Tensor]
"""Parameters and buffers of a module: as ``TensorDict.from_module`` has them, or a flat list."""

_PATHS: WeakKeyDictionary[nn.Module, list[tuple[str, ...]]] = WeakKeyDictionary()
_SLOTS: WeakKeyDictionary[nn.Module, list[tuple[dict[str, Tensor], str]]] = WeakKeyDictionary()


@contextmanager
def holding(module: nn.Module, params: Weights) -> Iterator[None]:
    """Puts parameters and buffers into a module inside a ``with`` block.

    It is ``params.to_module(module)`` without its bookkeeping, which takes a tenth of a small
    update in eager mode; a compiled loss uses tensordict's own.

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
    """Parameters and buffers in the order in which the module lists its own.

    Args:
        params: in the layout of ``TensorDict.from_module(module)``.
        module: the module.
    """
    # TensorDictParams wraps each of its own methods; the TensorDict inside does not.
    params = getattr(params, "_param_td", params)
    found = []
    _slots(module)
    for path in _PATHS[module]:
        value: Any = params
        for part in path:
            # A plain TensorDict's own dictionary: get() is slow.
            held = getattr(value, "_tensordict", None)
            value = value.get(part) if held is None else held[part]
        found.append(value)
    return found


def unbound(weights: Weights) -> Iterable[Any]:
    """The parameters of each member, of parameters that are stacked along a first dimension."""
    if isinstance(weights, list):
        return map(list, zip(*(leaf.unbind(0) for leaf in weights), strict=True))
    return weights.unbind(0)


def shared_keys(loss: nn.Module) -> dict[str, list[NestedKey]]:
    """By network of a loss, the keys of the parameters that it shares with the generator."""
    generator = loss._modules.get("generator_params")
    own = set() if generator is None else {id(p) for p in generator.parameters()}
    return {
        name: [key for key, value in params.items(True, True) if id(value) in own]
        for name, params in loss.named_children()
        if isinstance(params, TensorDictParams) and name != "generator_params"
    }


def without_gradient(params: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """The parameters, some of them detached."""
    copy = TensorDict(params.flatten_keys(".").to_dict()).unflatten_keys(".")
    return copy.update({key: params[key].detach() for key in keys})


def read(module: TensorDictModule, tensordict: TensorDictBase) -> TensorDictBase:
    """Runs a network on the data.

    Raises:
        BMRLError: naming what it reads, with the shapes, if the data do not fit.
    """
    if torch.compiler.is_compiling():
        return module(tensordict)
    try:
        return module(tensordict)
    except torch.OutOfMemoryError:
        raise
    except (RuntimeError, KeyError) as error:
        raise unfit(module, tensordict, error) from error


def unfit(
    module: Any, tensordict: TensorDictBase, error: Exception, also: Sequence[NestedKey] = ()
) -> BMRLError:
    """The error for data that a network cannot read.

    Args:
        module: the network.
        tensordict: the data.
        error: that it raised.
        also: keys that it reads beside its ``in_keys``.
    """
    keys = dict.fromkeys([*module.in_keys, *also])
    entries = [(key, tensordict.get(key, None)) for key in keys]
    seen = ", ".join(
        f"{key!r} {'missing' if x is None else f'{tuple(x.shape)} {x.dtype}'}" for key, x in entries
    )
    types = {x.dtype for _, x in entries if x is not None and x.is_floating_point()}
    weight = next(module.parameters(), None)
    other = weight is not None and bool(types) and types != {weight.dtype}
    return BMRLError(
        f"a network cannot read {seen} ({error}); valid: the sizes and types that it was made for"
        + other
        * f". Its parameters are {getattr(weight, 'dtype', '')}: convert the data, as "
        "torchrl.envs.transforms.DoubleToFloat does, or the loss, as loss.double() does"
    )


def _fill(slots: Sequence[tuple[dict[str, Tensor], str]], values: Sequence[Tensor]) -> None:
    for (owner, name), value in zip(slots, values, strict=True):
        owner[name] = value


def _slots(module: nn.Module) -> list[tuple[dict[str, Tensor], str]]:
    """Dictionaries and names of a module's parameters and buffers, in its tensordict's order."""
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


def share_as(loss: nn.Module, copy: nn.Module) -> None:
    """Lets a copy of a loss share parameters between its networks as the original does.

    Each ``TensorDictParams`` copies its own parameters, which separates shared ones.

    Args:
        loss: the original.
        copy: changed in place.

    Example:
        >>> shared = TensorDictParams(TensorDict.from_module(nn.Linear(1, 1)))
        >>> loss = nn.ModuleDict({"a": shared, "b": shared.copy()})
        >>> share_as(loss, loss)
    """
    places: dict[int, list[tuple[str, NestedKey]]] = {}
    for name, params in loss.named_children():
        if isinstance(params, TensorDictParams):
            for key, leaf in params._param_td.items(True, True):
                places.setdefault(id(leaf), []).append((name, key))
    for (first, key), *others in places.values():
        for name, other in others:
            held: Any = copy.get_submodule(name)
            origin: Any = copy.get_submodule(first)
            with held._param_td.unlock_():
                held._param_td.set(other, origin._param_td.get(key))
            held._reset_params()
