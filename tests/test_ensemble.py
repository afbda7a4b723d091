"""FrozenEnsemble: module i on row i, whatever the modules look like."""

from __future__ import annotations

import pickle
from copy import deepcopy
from typing import Any

import pytest
import torch
from helpers import state
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.objectives.ensemble import FrozenEnsemble


def modules(*widths: int, activation: type[nn.Module] = nn.Tanh) -> list[TensorDictModule]:
    torch.manual_seed(0)
    return [
        TensorDictModule(
            nn.Sequential(nn.Linear(3, width), activation(), nn.Linear(width, 2)),
            in_keys=["x"],
            out_keys=["y"],
        ).double()
        for width in widths
    ]


def rows(number: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(number, 5, 3, dtype=torch.float64, generator=generator)
    return TensorDict({"x": x}, [number, 5])


class Scaled(nn.Module):
    """A network with a number, or a tensor, that is neither parameter nor buffer."""

    def __init__(self, network: nn.Module, scale: float | Tensor) -> None:
        super().__init__()
        self.network, self.scale = network, scale

    def forward(self, x: Tensor) -> Tensor:
        scale = self.scale
        return (scale.mean() if isinstance(scale, Tensor) else scale) * self.network(x)


def mixed() -> list[TensorDictModule]:
    return [*modules(8), *modules(8, activation=nn.ReLU)]


def scaled(*scales: float | Tensor) -> list[TensorDictModule]:
    return [
        TensorDictModule(Scaled(module.module, scale), in_keys=["x"], out_keys=["y"])
        for module, scale in zip(modules(*[8] * len(scales)), scales, strict=True)
    ]


def long(middle: float) -> Tensor:
    """Numbers of which PyTorch prints only the first and the last."""
    return torch.ones(2000, dtype=torch.float64).index_fill_(0, torch.tensor(1000), middle)


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize(
    ("group", "stacked"),
    [
        (modules(8, 8, 8), True),
        (modules(8), True),
        (modules(8, 4, 8), False),
        (mixed(), False),
        (scaled(1.0, 2.0), False),
        (scaled(long(1.0), long(9.0)), False),
    ],
    ids=["equal", "single", "widths", "activations", "numbers", "tensors"],
)
def test_module_i_runs_on_row_i(group: list[TensorDictModule], stacked: bool, loop: bool) -> None:
    data = rows(len(group))
    expected = torch.stack([module.module(x) for module, x in zip(group, data["x"], strict=True)])
    ensemble = FrozenEnsemble(group)
    torch.testing.assert_close(ensemble(data, loop=loop)["y"], expected)
    assert ensemble.stacked == stacked


@pytest.mark.parametrize("widths", [(8, 8), (8, 4)])
def test_the_modules_are_copied_and_frozen(widths: tuple[int, ...]) -> None:
    group, data = modules(*widths), rows(2)
    ensemble = FrozenEnsemble(group)
    expected = ensemble(data.clone())["y"]
    assert not expected.requires_grad
    assert list(ensemble.parameters()) == []
    assert len(ensemble.state_dict()) > 0
    for module in group:
        assert all(parameter.requires_grad for parameter in module.parameters())
        for parameter in module.parameters():
            parameter.data.add_(1.0)
    assert torch.equal(ensemble(data)["y"], expected)


@pytest.mark.parametrize("widths", [(8, 8), (8, 4)])
def test_state_copies_and_dtype_reach_every_module(widths: tuple[int, ...]) -> None:
    ensemble, data = FrozenEnsemble(modules(*widths)), rows(2)
    expected = ensemble(data.clone())["y"]
    other = modules(*widths)
    for module in other:
        module.module[0].weight.data.zero_()
    other: Any = FrozenEnsemble(other)
    assert not torch.equal(other(data.clone())["y"], expected)
    other.load_state_dict(state(ensemble), strict=True)
    for twin in (other, deepcopy(ensemble), pickle.loads(pickle.dumps(ensemble))):
        assert torch.equal(twin(data.clone())["y"], expected)
    assert ensemble.float()(data.float())["y"].dtype == torch.float32


def test_keys_are_those_of_all_modules() -> None:
    group = [
        TensorDictModule(nn.Linear(3, 2), in_keys=[key], out_keys=["y"]) for key in ("a", "b", "a")
    ]
    assert FrozenEnsemble(group).in_keys == ["a", "b"]
