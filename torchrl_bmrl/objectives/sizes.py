"""Sizes of the entries that several networks of a loss share, and networks without shapes yet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.swap import unfit

Sizes = Mapping[NestedKey, Any]
"""By entry, the size of its last dimension, or its shape without the batch dimensions."""


def agreed_sizes(networks: Iterable[tuple[str, Any]]) -> dict[NestedKey, int]:
    """Sizes of the entries, as the networks declare them (``network.sizes``).

    Args:
        networks: names and networks; those that declare no sizes are skipped.

    Raises:
        BMRLError: if two of them declare different sizes of one entry.
    """
    known: dict[NestedKey, tuple[str, int]] = {}
    for name, network in networks:
        for key, size in (getattr(network, "sizes", None) or {}).items():
            first, other = known.setdefault(key, (name, size))
            if other != size:
                raise BMRLError(
                    f"{key!r} has the size {other} in {first} and {size} in {name}; valid: one "
                    "size for all networks"
                )
    return {key: size for key, (_, size) in known.items()}


def parts_of(network: Any) -> list[Any]:
    """The networks with keys inside a generator or an ensemble."""
    critics = getattr(network, "critics", None)
    if critics is not None:
        return list(critics)
    parts = [getattr(network, name, None) for name in ("encoder", "decoder")]
    return [part for part in parts if part is not None] or [network]


def is_lazy(network: Any) -> bool:
    """Whether a network has parameters that get their shapes at its first run."""
    return any(torch.nn.parameter.is_lazy(p) for p in network.parameters())


def check_fit(name: str, network: TensorDictModule, sizes: Sizes) -> None:
    """Runs a network once on entries of the known sizes, which gives a lazy one its parameters.

    The run is on the meta device and computes nothing. A network that reads an entry of unknown
    size is checked at the first batch instead.

    Args:
        name: of the network, for the message.
        network: the network.
        sizes: of the entries.

    Raises:
        BMRLError: if the network cannot read them, or writes another size than a known one.
    """
    if any(key not in sizes for key in network.in_keys):
        return
    warm_up(name, network, sizes)
    try:
        copy = deepcopy(network).to("meta")
    except (NotImplementedError, RuntimeError, TypeError):
        return  # a network that cannot be copied is checked at the first batch
    _run(name, copy, sizes, "meta")


def shapes_of(tensordict: TensorDictBase, keys: Iterable[NestedKey], ndim: int) -> dict[Any, Any]:
    """Shapes of the entries that the data have, without the batch dimensions."""
    data = {key: tensordict.get(key, None) for key in keys}
    return {key: value.shape[ndim:] for key, value in data.items() if value is not None}


def warm_up(name: str, network: TensorDictModule, sizes: Sizes) -> None:
    """Gives a lazy network its parameters, by a run on zeros.

    Args:
        name: of the network, for the message.
        network: the network; one that is not lazy is left unchanged.
        sizes: of the entries that it reads.

    Raises:
        BMRLError: if an entry's size is not known, or the network cannot read them.
    """
    if not is_lazy(network):
        return
    unknown = [key for key in network.in_keys if key not in sizes]
    if unknown:
        raise BMRLError(
            f"{name} has parameters without a shape and reads {unknown}, whose size is not known; "
            f"valid: a network that has run once, {name}(data)"
        )
    # In evaluation mode: the run must not change the statistics of a BatchNorm.
    training = network.training
    with torch.no_grad():
        _run(name, network.eval(), sizes, None)
    network.train(training)


def _run(name: str, network: Any, sizes: Sizes, device: str | None) -> None:
    weight = next((p for p in network.parameters() if p.is_floating_point()), None)
    device = device or (None if weight is None else str(weight.device))
    dtype = None if weight is None else weight.dtype
    entries = {
        key: torch.zeros(2, *_shape(sizes[key]), device=device, dtype=dtype)
        for key in network.in_keys
    }
    try:
        written = network(TensorDict(entries, [2]))
    except NotImplementedError:
        return
    except RuntimeError as error:
        if "meta" in str(error):
            return  # it reads numbers, or holds a tensor that did not move
        raise unfit(network, TensorDict(entries, [2]), error) from error
    for key in network.out_keys:
        value = written.get(key, None)
        if value is not None and key in sizes and value.shape[1:] != _shape(sizes[key]):
            raise BMRLError(
                f"{name} writes {key!r} of the size {value.shape[-1]}; valid: {sizes[key]}, as the "
                "other networks have it"
            )


def _shape(size: Any) -> tuple[int, ...]:
    return (size,) if isinstance(size, int) else tuple(size)
