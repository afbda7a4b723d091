"""Measurements of a loss: its values, its gradients, and its state."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_bmrl.errors import BMRLError


def run(loss: LossModule, data: TensorDict, seed: int = 0) -> TensorDict:
    """The losses for one seed of the random numbers."""
    torch.manual_seed(seed)
    return loss(data)


def by_method(loss: Any, term: str, data: TensorDict, seed: int = 0) -> Tensor:
    """One term from its own method, for one seed."""
    torch.manual_seed(seed)
    return getattr(loss, f"{term}_loss")(data)[0]


def total(losses: TensorDict, *terms: str) -> Tensor:
    """Sum of the named terms, or of all."""
    keys = [f"loss_{term}" for term in terms] or sorted(losses.keys())
    return reduce(add, (losses[key] for key in keys if key.startswith("loss_")))


def same(a: TensorDict, b: TensorDict) -> bool:
    """Whether both have equal keys and exactly equal values."""
    keys = set(a.keys(True, True))
    return keys == set(b.keys(True, True)) and all(torch.equal(a[key], b[key]) for key in keys)


def assert_same(a: TensorDict, b: TensorDict, what: str) -> None:
    """Fails unless both have equal keys and exactly equal values."""
    one, other = (dict(each.items(True, True)) for each in (a, b))
    differ = [
        str(key)
        for key in one | other
        if key not in one or key not in other or not torch.equal(one[key], other[key])
    ]
    assert not differ, f"{what}: {', '.join(differ)} differ"


def as_keywords(data: TensorDict, keys: list[Any]) -> dict[str, Tensor]:
    """The entries under the names of TorchRL's keyword dispatch."""
    return {"_".join((key,) if isinstance(key, str) else key): data[key] for key in keys}


def state(module: nn.Module) -> dict[str, Tensor]:
    """A copy of the state_dict."""
    return {key: value.clone() for key, value in module.state_dict().items()}


def gradients(loss: LossModule) -> dict[str, Tensor]:
    """Gradient of every parameter, zero where there is none."""
    return {
        name: torch.zeros_like(p) if p.grad is None else p.grad.clone()
        for name, p in loss.named_parameters()
    }


def network_of(name: str) -> str:
    """The network that a parameter of the loss belongs to.

    Example:
        >>> network_of("actor_network_params.module.0.weight")
        'actor_network'
    """
    return name.split("_params.")[0]


def reached(loss: LossModule) -> set[str]:
    """Networks with a gradient that is not zero."""
    return {network_of(name) for name, grad in gradients(loss).items() if grad.any()}


def all_of(trains: Any) -> set[str]:
    """Every network that some term trains."""
    return {name for names in trains.values() for name in names}


def refused(loss: LossModule, data: TensorDict, *words: str) -> None:
    """Fails unless the loss raises an error with the given words and has written nothing."""
    before = dict(data.items(True, True))
    with pytest.raises(BMRLError) as error:
        loss(data)
    for word in words:
        assert word in str(error.value), f"the error does not name {word}: {error.value}"
    unwritten(data, before, "a refused batch")


def unwritten(data: TensorDict, before: dict[Any, Tensor], what: str) -> None:
    """Fails if an entry of the data was added, removed or replaced."""
    after = dict(data.items(True, True))
    changed = {key for key in after.keys() | before.keys() if after.get(key) is not before.get(key)}
    assert not changed, f"the loss changed {sorted(map(str, changed))} of {what}"
