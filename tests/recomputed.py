"""Networks whose calls are recorded, and networks in plain numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor, nn


def recorded(module: nn.Module) -> list[tuple[tuple[Tensor, ...], Tensor]]:
    """Inputs and output of every later call of a module."""
    calls: list[tuple[tuple[Tensor, ...], Tensor]] = []
    module.register_forward_hook(
        lambda _, inputs, output: calls.append(
            (tuple(x.detach().clone() for x in inputs), output.detach().clone())
        )
    )
    return calls


def numpy_mlp(parameters: Any, *inputs: Any) -> np.ndarray:
    """A ReLU network in plain numpy, from a tensordict of its layers' weights and biases."""
    x = np.concatenate([np.asarray(value) for value in inputs], -1)
    layers = sorted(parameters.keys(), key=int)
    for layer in layers:
        weight = parameters[layer, "weight"].detach().numpy()
        x = x @ weight.T + parameters[layer, "bias"].detach().numpy()
        if layer != layers[-1]:
            x = np.maximum(x, 0.0)
    return x


def numpy_decoder(parameters: Any, *inputs: Any) -> np.ndarray:
    """A decoder with bounds of ±1 in plain numpy."""
    return np.tanh(numpy_mlp(parameters["module", "network"], *inputs))
