"""Agents of stage 1: their losses, and how to build them from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import UnknownNameError
from torchrl_bmrl.generators import LatentGenerator
from torchrl_bmrl.modules import (
    ActionFlow,
    ActionMixture,
    ActionVAE,
    make_perturbation_network,
    make_qvalue_network,
)
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.training.checkpoint import load_checkpoint
from torchrl_bmrl.training.networks import build

_SIX_TASKS = {"observation_dim": 33, "action_dim": 7}
"""Sizes of older checkpoints, which do not contain them."""


GENERATORS: dict[str, Callable[..., LatentGenerator]] = {
    "autoencoder": ActionVAE,
    "flow": ActionFlow,
    "gaussian": partial(ActionMixture, num_components=1),
    "mixture": ActionMixture,
}
"""Generators of stage 1 by name."""


def make_bcq_loss(
    *,
    observation_dim: int,
    action_dim: int,
    num_cells: Sequence[int] = (256, 256),
    generator: str = "autoencoder",
    num_qvalue_nets: int = 2,
    layer_norm: bool = False,
    perturbation: bool = False,
    **options: Any,
) -> BCQLoss:
    """Returns a :class:`BCQLoss` over new networks.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        num_cells: widths of the hidden layers of every network.
        generator: name of the generator, of :data:`GENERATORS`.
        num_qvalue_nets: number of critics.
        layer_norm: whether the critics' hidden layers are normalised.
        perturbation: whether there is a perturbation network.
        **options: options of :class:`BCQLoss`.

    Raises:
        UnknownNameError: for another generator.
        BMRLError: for options that :class:`BCQLoss` refuses.

    Example:
        >>> make_bcq_loss(observation_dim=3, action_dim=2, num_cells=(8,)).num_qvalue_nets
        2
    """
    if generator not in GENERATORS:
        raise UnknownNameError("generator", generator, tuple(GENERATORS))
    dims = (observation_dim, action_dim)
    critic = partial(make_qvalue_network, *dims, num_cells=num_cells, layer_norm=layer_norm)
    return BCQLoss(
        GENERATORS[generator](*dims, num_cells=num_cells),
        [critic() for _ in range(num_qvalue_nets)],
        make_perturbation_network(*dims, num_cells=num_cells) if perturbation else None,
        bounds=(-1.0, 1.0),
        **options,
    )


def load_bcq_loss(path: Path) -> tuple[BCQLoss, dict[str, Any]]:
    """Loads a trained agent and its checkpoint's metadata (``task``, ``statistics``, ...).

    Args:
        path: the checkpoint, such as ``bcq/lift/checkpoint.safetensors`` of a run folder.

    Returns:
        the frozen loss and the metadata.

    Raises:
        CheckpointError: if the file is missing, damaged, of another kind or of other shapes.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.training.checkpoint import save_checkpoint
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> options = {"observation_dim": 3, "action_dim": 2, "num_cells": [8]}
        >>> state = {"module": make_bcq_loss(**options).state_dict()}
        >>> save_checkpoint(path, state, {"kind": "bcq", "task": "lift", "loss": options})
        >>> loss, metadata = load_bcq_loss(path)
        >>> loss.num_qvalue_nets, metadata["task"]
        (2, 'lift')
    """
    state, metadata = load_checkpoint(path, kind="bcq")
    options = with_sizes(metadata.get("loss"))
    return build(make_bcq_loss, options, state, path), metadata


def with_sizes(options: Any) -> Any:
    """Adds the sizes that are missing in older checkpoints to the options of networks.

    Args:
        options: of the networks, from a checkpoint.

    Example:
        >>> with_sizes({"num_tasks": 6})["action_dim"]
        7
    """
    if not isinstance(options, dict):
        return options  # an error is raised when the networks are built
    return _SIX_TASKS | {key: x for key, x in options.items() if key != "target_dtype"}
