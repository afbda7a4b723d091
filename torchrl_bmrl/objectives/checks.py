"""What the losses ask of their options and of the data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from math import inf, isfinite
from numbers import Integral, Real
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Composite

from torchrl_bmrl.errors import BMRLError

TOLERANCE = 1e-3
"""An action may lie outside its bounds by this share of their distance: it is rounding."""


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
        value: what was given: a Python or numpy number, or a tensor of one.
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


def check_one_hot(key: NestedKey, action: Tensor, valid: Tensor | None) -> None:
    """Refuses rows that name no action, or several; on CPU and not compiled.

    A row names an action where one entry is above a half and the others together are below it:
    0.999 and a smoothed label do.

    Args:
        key: of the action.
        action: ``(*B, n)``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Raises:
        BMRLError: naming the first such row.

    Example:
        >>> check_one_hot("action", torch.tensor([[0.0, 0.999], [0.9, 0.1]]), None)
        >>> check_one_hot("action", torch.tensor([[0.5, 0.5]]), None)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: 'action' names no single action in 1 rows, the first, ...
    """
    if not readable(action):
        return
    weight = action.to(torch.get_default_dtype())
    largest = weight.amax(-1)
    others = weight.abs().sum(-1) - largest
    unclear = ~((largest > 0.5) & (others < 0.5))
    if valid is not None:
        unclear &= valid
    if unclear.any():
        first = tuple(unclear.nonzero()[0].tolist())
        raise BMRLError(
            f"{key!r} names no single action in {int(unclear.sum())} rows, the first, "
            f"{action[first].tolist()}, at {first}; valid: rows with one entry near 1 and the "
            "others near 0"
        )


def check_within(
    key: NestedKey, action: Tensor, low: Tensor, high: Tensor, valid: Tensor | None
) -> None:
    """Refuses actions that no policy within the bounds can take; on CPU and not compiled.

    Args:
        key: of the action.
        action: ``(*B, action_dim)``.
        low: lower bound, ``()`` or ``(action_dim,)``.
        high: upper bound, likewise.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Raises:
        BMRLError: naming the first such number, or bounds of another length.

    Example:
        >>> low, high = torch.tensor(-1.0), torch.tensor(1.0)
        >>> check_within("action", torch.tensor([[0.5, 1.9]]), low, high, None)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: 'action' holds 1 numbers outside the bounds, the first, ...
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
    if valid is not None:
        outside &= valid.unsqueeze(-1)
    if outside.any():
        first = tuple(outside.nonzero()[0].tolist())
        raise BMRLError(
            f"{key!r} holds {int(outside.sum())} numbers outside the bounds, the first, "
            f"{action[first].item():g}, at {first}; valid: {low.tolist()} to {high.tolist()}, or "
            "bounds of the loss and of the generator that are those of the data"
        )


def leaf_of(spec: Any, key: NestedKey) -> Any:
    """The spec of one entry: itself, or that entry or the only one of a composite spec.

    Args:
        spec: of the action.
        key: where it lies in a composite spec.

    Raises:
        BMRLError: for a composite spec with several entries, none of them under the key.

    Example:
        >>> from torchrl.data import Composite, OneHot
        >>> leaf_of(Composite(agent=Composite(move=OneHot(4))), "action").space.n
        4
    """
    if not isinstance(spec, Composite):
        return spec
    keys = list(spec.keys(include_nested=True, leaves_only=True))
    if key in keys:
        return spec[key]
    if len(keys) != 1:
        raise BMRLError(f"the spec has {keys}, not {key!r}; valid: the spec of the action alone")
    return spec[keys[0]]


def check_rows_of_tasks(key: NestedKey, task: Tensor, valid: Tensor | None) -> None:
    """Refuses rows that hold another task than their number; on CPU and not compiled.

    Args:
        key: of the task.
        task: class index, ``(num_tasks, B)``.
        valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.

    Raises:
        BMRLError: naming the first row that holds another task.

    Example:
        >>> check_rows_of_tasks("task", torch.tensor([[0, 0], [1, 1]]), None)
        >>> check_rows_of_tasks("task", torch.tensor([[0, 1], [0, 1]]), None)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: 'task' holds 1 in row 0; valid: 0 there, since row i of ...
    """
    if not readable(task):
        return
    wrong = task != torch.arange(len(task), device=task.device).unsqueeze(-1)
    if valid is not None:
        wrong &= valid
    if wrong.any():
        row, column = wrong.nonzero()[0].tolist()
        raise BMRLError(
            f"{key!r} holds {int(task[row, column])} in row {row}; valid: {row} there, since row i "
            "of the data is the i-th teacher's task"
        )


def readable(value: Tensor) -> bool:
    """Whether Python may look at the numbers: on CPU, neither compiled nor under vmap."""
    return not (
        torch.compiler.is_compiling()
        or value.device.type != "cpu"
        or torch.func.debug_unwrap(value).ndim > value.ndim  # under vmap a dimension is hidden
    )


def next_key(key: NestedKey) -> tuple[str, ...]:
    """The key under ``"next"``.

    Example:
        >>> next_key("reward"), next_key(("agent", "reward"))
        (('next', 'reward'), ('next', 'agent', 'reward'))
    """
    return ("next", key) if isinstance(key, str) else ("next", *key)


def entry(
    tensordict: TensorDictBase,
    key: NestedKey,
    mask: Tensor | None = None,
    readers: Callable[[NestedKey], list[str]] | None = None,
) -> Tensor:
    """One entry of the data, finite.

    On CPU a number that is not finite is refused; elsewhere that would wait for the device, and
    in a compiled loss it cannot be said.

    Args:
        tensordict: the data.
        key: of the entry.
        mask: which rows count, ``(*B,)``. The others may hold anything: they come back as zeros,
            so that nothing in them reaches a number or a gradient.
        readers: of a key the networks that read it, for the message.

    Raises:
        BMRLError: if it is missing, or holds NaN or infinity.

    Example:
        >>> entry(TensorDict({"reward": torch.tensor([1.0])}, []), "reward")
        tensor([1.])
    """
    value = tensordict.get(key, None)
    if value is None:
        raise missing(tensordict, key, readers(key) if readers else ())
    if mask is not None and value.shape[: mask.ndim] == mask.shape:
        valid = mask.reshape(*mask.shape, *[1] * (value.ndim - mask.ndim))
        value = torch.where(valid, value, torch.zeros_like(value))
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


# -- sizes, said in more than one place ------------------------------------------------------------

Sizes = Mapping[NestedKey, Any]
"""Of each entry the size of its last dimension, or the shape that it has beside the rows."""


def agreed_sizes(networks: Iterable[tuple[str, Any]]) -> dict[NestedKey, int]:
    """Sizes of the entries, as the networks say them (``network.sizes``).

    Args:
        networks: names and networks; those that say nothing are passed over.

    Raises:
        BMRLError: if two of them say different sizes of one entry.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> agreed_sizes([("generator", ActionVAE(3, 2)), ("critic", make_qvalue_network(3, 1))])
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: 'action' has the size 2 in generator and 1 in critic; ...
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
    """The networks with keys that a generator or an ensemble consists of."""
    critics = getattr(network, "critics", None)
    if critics is not None:
        return list(critics)
    parts = [getattr(network, name, None) for name in ("encoder", "decoder")]
    return [part for part in parts if part is not None] or [network]


def is_lazy(network: Any) -> bool:
    """Whether a network has parameters that get their shapes when it first runs."""
    return any(torch.nn.parameter.is_lazy(p) for p in network.parameters())


def check_fit(name: str, network: TensorDictModule, sizes: Sizes) -> None:
    """Runs a network once on entries of the known sizes; a lazy one gets its parameters by it.

    Nothing is computed: the run is on the meta device. A network that reads an entry of unknown
    size is left to the first batch.

    Args:
        name: of the network, for the message.
        network: what is run.
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
        return  # a network that cannot be copied is left to the first batch
    _run(name, copy, sizes, "meta")


def warm_up(name: str, network: TensorDictModule, sizes: Sizes) -> None:
    """Gives a lazy network its parameters, by a run on zeros.

    Args:
        name: of the network, for the message.
        network: what is run; one that is not lazy is left alone.
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
    # In evaluation: a run must not move the statistics of a BatchNorm.
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
            return  # it looks at numbers, or holds a tensor that did not move
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
