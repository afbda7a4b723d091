"""Checks of the networks that a student learns from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import check_bounds
from torchrl_bmrl.objectives.checks import check_network
from torchrl_bmrl.objectives.sizes import agreed_sizes, check_fit, warm_up
from torchrl_bmrl.ownership import check_trained


def check_teachers(
    students: Mapping[str, TensorDictModule],
    generators: Sequence[TensorDictModule],
    critics: Sequence[TensorDictModule],
    latent_key: NestedKey,
    latent_dim: int,
) -> None:
    """Checks that teachers and students fit together; gives lazy teachers their parameters.

    Args:
        students: the trained networks by name.
        generators: one decoder per task.
        critics: one critic per task.
        latent_key: key of the decoders' latent.
        latent_dim: its size.

    Raises:
        BMRLError: for numbers of teachers that differ, no teachers, a teacher that a loss has
            copied, or sizes or bounds of the action that differ.
    """
    if len(generators) != len(critics):
        raise BMRLError(
            f"{len(generators)} teacher_generators and {len(critics)} teacher_qvalue_networks; "
            "valid: one of each per task"
        )
    if not generators:
        raise BMRLError("no teachers; valid: at least one generator and critic")
    teachers = [("a teacher's generator", x) for x in generators]
    teachers += [("a teacher's critic", x) for x in critics]
    networks = [*students.items(), *teachers]
    for name, module in networks:
        check_network(name, module)
    for name, module in teachers:
        check_trained(name, module)
    sizes = agreed_sizes(networks)
    declared = sizes.setdefault(latent_key, latent_dim)
    if declared != latent_dim:
        raise BMRLError(
            f"latent_dim is {latent_dim}; valid: {declared}, the size that the decoders read"
        )
    for name, module in networks:
        check_fit(name, module, sizes)
    for name, module in teachers:
        warm_up(name, module, sizes)  # before it is copied
    decoders: list[Any] = [x for _, x in networks if getattr(x, "bounds", None) is not None]
    for decoder in decoders:
        check_bounds(decoder.bounds, decoders[0])


def per_task(name: str, values: Any, default: Tensor) -> Tensor:
    """An option with a number for each task, as a tensor.

    Args:
        name: the option; one that ends in ``scale`` must be above 0.
        values: what was given; ``None`` for the default.
        default: ``(num_tasks,)``.

    Raises:
        BMRLError: for another shape, or numbers that are not valid.
    """
    tensor = default if values is None else torch.as_tensor(values).to(default)
    scale = name.endswith("scale")
    valid = tensor.shape == default.shape and bool(tensor.isfinite().all())
    if not valid or (scale and not (tensor > 0).all()):
        raise BMRLError(
            f"{name} is {tensor.tolist()}; valid: a finite number for each of the {len(default)} "
            f"tasks{', above 0' * scale}"
        )
    return tensor
