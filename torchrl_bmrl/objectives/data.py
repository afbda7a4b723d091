"""Checked access to the entries of a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import isfinite

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError

Readers = Callable[[NestedKey], list[str]]
"""Returns the names of the networks that read a key."""

TOLERANCE = 1e-3
"""Share of the bounds' distance by which an action may lie outside them, because of rounding."""


def next_key(key: NestedKey) -> tuple[str, ...]:
    """The key under ``"next"``."""
    return ("next", key) if isinstance(key, str) else ("next", *key)


def own_name(key: NestedKey) -> NestedKey:
    """The name of an entry without its place, such as ``"next"``."""
    while isinstance(key, tuple) and key[0] in ("next", "previous", "context"):
        key = unravel_key(key[1:])
    return key


def readable(value: Tensor) -> bool:
    """Whether Python may read the numbers: on CPU, neither compiled nor under vmap."""
    return not (
        torch.compiler.is_compiling()
        or value.device.type != "cpu"
        or torch.func.debug_unwrap(value).ndim > value.ndim  # under vmap a dimension is hidden
    )


def entry(
    tensordict: TensorDictBase,
    key: NestedKey,
    mask: Tensor | None = None,
    readers: Readers | None = None,
) -> Tensor:
    """One entry of the data, checked to be finite.

    The check runs on CPU only: on a GPU it would wait for the device, and a compiled loss cannot
    raise.

    Args:
        tensordict: the data.
        key: of the entry.
        mask: which rows count, ``(*B,)``. The other rows may contain anything: they are returned
            as zeros, so that they affect no number and no gradient.
        readers: returns the names of the networks that read a key, for the message.

    Raises:
        BMRLError: if it is missing, or contains NaN or infinity.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise missing(tensordict, key, readers(key) if readers else ())
    if mask is not None and value.shape[: mask.ndim] == mask.shape:
        valid = mask.reshape(*mask.shape, *[1] * (value.ndim - mask.ndim))
        value = torch.where(valid, value, torch.zeros_like(value))
    if not readable(value):
        return value
    # The sum is cheap; it is infinite or NaN wherever a number is, and rarely otherwise.
    if value.is_floating_point() and not isfinite(value.sum().item()):
        infinite = ~value.isfinite()
        if (first := _first(infinite)) is not None:
            raise BMRLError(
                f"{key!r} holds {int(infinite.sum())} numbers that are not finite, the first, "
                f"{value[first].item()}, at {first}; valid: finite numbers"
            )
    return value


def select(
    tensordict: TensorDictBase,
    keys: Iterable[NestedKey],
    batch: torch.Size,
    mask: Tensor | None = None,
    *,
    under: NestedKey = (),
    readers: Readers | None = None,
) -> TensorDictBase:
    """Entries of the data, each checked by :func:`entry`, as a TensorDict with batch size ``*B``.

    Args:
        tensordict: the data.
        keys: of the entries; those of the result.
        batch: ``*B``.
        mask: which rows count, ``(*B,)``; ``None`` if all do.
        under: a key such as ``"next"`` that contains the entries.
        readers: returns the names of the networks that read a key, for the message.

    Raises:
        BMRLError: for an entry that is missing, not finite, or of another batch shape.
    """
    values = {}
    for key in keys:
        full = unravel_key((under, key))
        values[key] = value = entry(tensordict, full, mask, readers)
        if value.shape[: len(batch)] != batch:
            raise BMRLError(
                f"{full!r} has the shape {tuple(value.shape)}; valid: {tuple(batch)} and its own "
                "dimensions, as the action has"
            )
    if mask is None and tensordict.batch_size == batch and all(isinstance(k, str) for k in values):
        return (tensordict.get(under) if under else tensordict).select(*values)
    # A new TensorDict: what a keyword call nests has a batch size of its own.
    result = TensorDict({}, batch_size=batch)
    for key, value in values.items():
        result.set(key, value)
    return result


def missing(tensordict: TensorDictBase, key: NestedKey, readers: Sequence[str] = ()) -> BMRLError:
    """The error for an entry that the data lack.

    Args:
        tensordict: the data.
        key: of the entry.
        readers: the networks that read it under this name.
    """
    present = [str(key) for key in tensordict.keys(include_nested=True, leaves_only=True)]
    who = f", which {' and '.join(readers)} read{'s' * (len(readers) == 1)}" if readers else ""
    return BMRLError(f"the data have no {key!r}{who}; they have: {', '.join(present) or 'nothing'}")


def check_same_shape(key: NestedKey, value: Tensor, expected: Tensor) -> None:
    """Checks shapes that PyTorch would otherwise broadcast silently.

    Raises:
        BMRLError: naming the key and both shapes.
    """
    if value.shape != expected.shape:
        raise BMRLError(
            f"{key!r} has the shape {tuple(value.shape)}; valid: {tuple(expected.shape)}, as the "
            "networks have it"
        )


def check_index(key: NestedKey, index: Tensor, count: int) -> None:
    """Checks class indices; in a compiled loss or on a GPU only their type.

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


def check_one_hot(key: NestedKey, action: Tensor, valid: Tensor | None) -> None:
    """Checks that each row names one action; on CPU and not compiled.

    A row names an action if one entry is above a half and the others together are below it, which
    also holds for 0.999 and for smoothed labels.

    Args:
        key: of the action.
        action: ``(*B, n)``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Raises:
        BMRLError: naming the first row that names no action, or several.
    """
    if not readable(action):
        return
    weight = action.to(torch.get_default_dtype())
    largest = weight.amax(-1)
    others = weight.abs().sum(-1) - largest
    unclear = ~((largest > 0.5) & (others < 0.5))
    if (first := _first(unclear, valid)) is not None:
        raise BMRLError(
            f"{key!r} names no single action in {int(unclear.sum())} rows, the first, "
            f"{action[first].tolist()}, at {first}; valid: rows with one entry near 1 and the "
            "others near 0"
        )


def check_within(
    key: NestedKey, action: Tensor, low: Tensor, high: Tensor, valid: Tensor | None
) -> None:
    """Checks that actions lie within the bounds; on CPU and not compiled.

    Args:
        key: of the action.
        action: ``(*B, action_dim)``.
        low: lower bound, ``()`` or ``(action_dim,)``.
        high: upper bound, likewise.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Raises:
        BMRLError: naming the first number outside, or for bounds of another length.
    """
    if low.ndim and low.shape != action.shape[-1:]:
        raise BMRLError(
            f"{key!r} has the shape {tuple(action.shape)} and the bounds {tuple(low.shape)}; "
            "valid: a bound for each dimension"
        )
    if not readable(action):
        return
    if torch.maximum(low - action, action - high).amax().item() <= 0:
        return
    slack = TOLERANCE * (high - low)
    outside = (action < low - slack) | (action > high + slack)
    if (first := _first(outside, None if valid is None else valid.unsqueeze(-1))) is not None:
        raise BMRLError(
            f"{key!r} holds {int(outside.sum())} numbers outside the bounds, the first, "
            f"{action[first].item():g}, at {first}; valid: {low.tolist()} to {high.tolist()}, or "
            "bounds of the loss and of the generator that are those of the data"
        )


def check_tasks(key: NestedKey, task: Tensor, shape: torch.Size, valid: Tensor | None) -> None:
    """Checks that row i of the data belongs to task i; the numbers on CPU and not compiled.

    Args:
        key: of the task.
        task: class index.
        shape: that it must have, ``(num_tasks, B)``.
        valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.

    Raises:
        BMRLError: for another shape or type, or naming the first row with another task.
    """
    if task.shape != shape:
        raise BMRLError(f"{key!r} has the shape {tuple(task.shape)}; valid: {tuple(shape)}")
    check_index(key, task, shape[0])
    if not readable(task):
        return
    wrong = task != torch.arange(len(task), device=task.device).unsqueeze(-1)
    if (first := _first(wrong, valid)) is not None:
        row, column = first
        raise BMRLError(
            f"{key!r} holds {int(task[row, column])} in row {row}; valid: {row} there, since row i "
            "of the data belongs to the i-th teacher's task"
        )


def _first(flags: Tensor, valid: Tensor | None = None) -> tuple[int, ...] | None:
    """Index of the first true entry in the rows that count, which it sets to false elsewhere."""
    if valid is not None:
        flags &= valid
    return tuple(flags.nonzero()[0].tolist()) if flags.any() else None
