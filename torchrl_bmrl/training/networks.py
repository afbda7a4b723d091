"""Builds the networks that a checkpoint describes, and takes no memory that its tensors do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.training.checkpoint import check_shapes, load_state

MOST = 2000
"""Weights and biases of all networks of a checkpoint: each takes time, whatever its size. Two
critics and a generator have about 30."""

Built = TypeVar("Built", bound=nn.Module)


def build(make: Callable[..., Built], options: Any, state: Mapping[str, Any], path: Path) -> Built:
    """Builds the frozen networks of a checkpoint.

    They are built on the meta device first, without memory, and compared with the tensors of the
    file: a file of a kilobyte can ask for networks of gigabytes.

    Args:
        make: builds the networks.
        options: keyword arguments of ``make``, from the checkpoint's metadata.
        state: state of the checkpoint, with the parameters under ``module``.
        path: path of the checkpoint, for the message.

    Raises:
        CheckpointError: if ``make`` refuses the options, or the parameters do not fit the networks
            or are not finite.
    """
    params = state.get("module")
    if not isinstance(options, dict) or not isinstance(params, dict):
        raise CheckpointError(path, "contains no networks; valid: the checkpoint of a module")
    tensors = [value for value in params.values() if isinstance(value, Tensor)]
    # A tensor without elements may claim any shape.
    largest = max((size for x in tensors if x.numel() for size in x.shape), default=0)
    for name, option in options.items():
        sizes = option if isinstance(option, list) else [option]
        whole = [size for size in sizes if isinstance(size, int)]
        if len(sizes) > len(tensors) or any(abs(size) > largest for size in whole):
            raise CheckpointError(path, f"{name} is {option}; no tensor in the file is that large")
    try:
        with torch.device("meta"), _at_most(MOST):
            meant = make(**options)
        check_shapes(meant, params, path)
        module = make(**options)
    except CheckpointError:
        raise
    except (AttributeError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(path, f"its options build no networks ({error})") from error
    load_state(module, params, path)
    for key, tensor in params.items():
        if not tensor.isfinite().all():
            raise CheckpointError(path, f"{key!r} contains numbers that are not finite")
    return module.requires_grad_(False)


@contextmanager
def _at_most(number: int) -> Iterator[None]:
    """Ends the construction of more parameters than this number."""
    made = count(1)

    def registered(*_: Any) -> None:
        if next(made) > number:
            raise ValueError(f"they ask for more than {number} weights and biases")

    handle = register_module_parameter_registration_hook(registered)
    try:
        yield
    finally:
        handle.remove()
