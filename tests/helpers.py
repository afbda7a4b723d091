"""Builders that several test files share: small networks, random transitions, plain numpy networks.

Everything is float64, so that an independent numpy computation can be compared closely.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.modules import (
    ActionVAE,
    make_decoder,
    make_perturbation_network,
    make_qvalue_network,
    make_task_classifier,
    make_task_encoder,
)
from torchrl_bmrl.objectives import BCQLoss, MetaDistillationLoss

OBSERVATION_DIM, ACTION_DIM, LATENT_DIM, TASK_LATENT_DIM = 3, 2, 4, 2
CELLS = (8,)
NO_UPDATER = "ignore:No target network updater"


def transitions(*batch: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> TensorDict:
    """Random transitions; the first row of every batch is terminated, the second truncated."""
    generator = torch.Generator().manual_seed(seed)

    def randn(size: int) -> Tensor:
        return torch.randn(*batch, size, dtype=dtype, generator=generator)

    row = torch.arange(batch[-1]).expand(batch).unsqueeze(-1)
    return TensorDict(
        {
            "observation": randn(OBSERVATION_DIM),
            "action": randn(ACTION_DIM).tanh(),
            "next": {
                "observation": randn(OBSERVATION_DIM),
                "reward": randn(1),
                "done": row < 2,
                "terminated": row == 0,
                "truncated": row == 1,
            },
        },
        batch_size=batch,
    )


def task_transitions(num_tasks: int, rows: int, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Random transitions of several tasks, each with the one before it."""
    data = transitions(num_tasks, rows, dtype=dtype)
    data["task"] = torch.arange(num_tasks).unsqueeze(-1).expand(num_tasks, rows).clone()
    data["previous"] = transitions(num_tasks, rows, dtype=dtype, seed=1)
    return data


def as_keywords(data: TensorDict, keys: list[Any]) -> dict[str, Tensor]:
    """The entries under the names of TorchRL's keyword dispatch."""
    return {"_".join((key,) if isinstance(key, str) else key): data[key] for key in keys}


def make_bcq_loss(
    *,
    perturbation: bool = False,
    num_critics: int = 2,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    **options: Any,
) -> BCQLoss:
    """A small loss whose target networks differ from the trained ones."""
    torch.manual_seed(seed)
    dims = (OBSERVATION_DIM, ACTION_DIM)
    loss = BCQLoss(
        ActionVAE(*dims, num_cells=CELLS).to(dtype),
        [make_qvalue_network(*dims, num_cells=CELLS).to(dtype) for _ in range(num_critics)],
        make_perturbation_network(*dims, num_cells=CELLS).to(dtype) if perturbation else None,
        **{"bounds": (-1.0, 1.0), **options},
    )
    for name, target in loss.named_children():
        if name.startswith("target_"):
            for value in target.values(True, True):
                value.data.add_(torch.randn_like(value), alpha=0.3)
    return loss


def make_student_networks(num_tasks: int, dtype: torch.dtype) -> list[TensorDictModule]:
    """Encoder, classifier, generator and critic of a student."""
    dims = (OBSERVATION_DIM, ACTION_DIM)
    networks = [
        make_task_encoder(*dims, TASK_LATENT_DIM, num_cells=CELLS),
        make_task_classifier(num_tasks, TASK_LATENT_DIM),
        make_decoder(*dims, LATENT_DIM, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS),
        make_qvalue_network(*dims, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS),
    ]
    return [network.to(dtype) for network in networks]


def make_teachers(
    num_tasks: int, dtype: torch.dtype = torch.float64
) -> tuple[list[TensorDictModule], list[TensorDictModule]]:
    """One decoder and one critic per task."""
    dims = (OBSERVATION_DIM, ACTION_DIM)
    return (
        [make_decoder(*dims, LATENT_DIM, num_cells=CELLS).to(dtype) for _ in range(num_tasks)],
        [make_qvalue_network(*dims, num_cells=CELLS).to(dtype) for _ in range(num_tasks)],
    )


def make_distillation_loss(
    *, num_tasks: int = 3, dtype: torch.dtype = torch.float64, seed: int = 0, **options: Any
) -> MetaDistillationLoss:
    """A small loss with teachers of its own."""
    torch.manual_seed(seed)
    return MetaDistillationLoss(
        *make_student_networks(num_tasks, dtype),
        *make_teachers(num_tasks, dtype),
        **{"latent_dim": LATENT_DIM, "context": "current", **options},
    )


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
