"""Builders that several test files share: small networks, random transitions, plain numpy networks.

Everything is float64, so that an independent numpy computation can be compared closely.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.modules import MLP
from torchrl.objectives import LossModule

from torchrl_bmrl.modules import (
    ActionVAE,
    make_decoder,
    make_latent_actor,
    make_perturbation_network,
    make_qvalue_network,
    make_task_classifier,
    make_task_encoder,
)
from torchrl_bmrl.modules.generator import make_mlp
from torchrl_bmrl.objectives import (
    BCQLoss,
    DiscreteBCQLoss,
    FQELoss,
    GenerativeLoss,
    MetaDistillationLoss,
    PLASLoss,
)

OBSERVATION_DIM, ACTION_DIM, LATENT_DIM, TASK_LATENT_DIM = 3, 2, 4, 2
NUM_ACTIONS = 3
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


def discrete_transitions(
    *batch: int,
    action_space: str = "one-hot",
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> TensorDict:
    """Random transitions whose actions are one of ``NUM_ACTIONS``."""
    data = transitions(*batch, dtype=dtype, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    action = torch.randint(NUM_ACTIONS, batch, generator=generator)
    data["action"] = one_hot(action, NUM_ACTIONS) if action_space == "one-hot" else action
    return data


def task_transitions(num_tasks: int, rows: int, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Random transitions of several tasks, each with the one before it."""
    data = transitions(num_tasks, rows, dtype=dtype)
    data["task"] = torch.arange(num_tasks).unsqueeze(-1).expand(num_tasks, rows).clone()
    data["previous"] = transitions(num_tasks, rows, dtype=dtype, seed=1)
    return data


def as_keywords(data: TensorDict, keys: list[Any]) -> dict[str, Tensor]:
    """The entries under the names of TorchRL's keyword dispatch."""
    return {"_".join((key,) if isinstance(key, str) else key): data[key] for key in keys}


# -- losses: every network passes through `edit` before the loss takes it --------------------------

Edit = Callable[[TensorDictModule], TensorDictModule]


def unchanged(module: TensorDictModule) -> TensorDictModule:
    return module


class OnTorso(nn.Module):
    """A network that reads features of the observation; it has a parameter of its own, too."""

    def __init__(self, torso: nn.Module, head: nn.Module) -> None:
        super().__init__()
        self.torso, self.head = torso, head
        gain = torch.rand(OBSERVATION_DIM, dtype=next(torso.parameters()).dtype)
        self.gain = nn.Parameter(gain)

    def forward(self, observation: Tensor, *inputs: Tensor) -> Any:
        return self.head(self.gain * self.torso(observation), *inputs)


class Dropped(nn.Module):
    """A network with dropout after its output."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network, self.dropout = network, nn.Dropout(0.5)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.dropout(self.network(*inputs))


def make_generator(dtype: torch.dtype, edit: Edit = unchanged) -> ActionVAE:
    """A small variational autoencoder."""
    generator = ActionVAE(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS).to(dtype)
    generator.encoder, generator.decoder = edit(generator.encoder), edit(generator.decoder)
    return generator


def make_critics(number: int, dtype: torch.dtype, edit: Edit = unchanged) -> list[TensorDictModule]:
    """Small critics of continuous actions."""
    dims = (OBSERVATION_DIM, ACTION_DIM)
    return [edit(make_qvalue_network(*dims, num_cells=CELLS).to(dtype)) for _ in range(number)]


def make_perturbation(dtype: torch.dtype, edit: Edit = unchanged) -> TensorDictModule:
    """A small perturbation network."""
    return edit(make_perturbation_network(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS).to(dtype))


def with_moved_targets(loss: LossModule) -> Any:
    """The loss, its target networks moved away from the trained ones."""
    for name, target in loss.named_children():
        if name.startswith("target_"):
            for value in target.values(True, True):
                value.data.add_(torch.randn_like(value), alpha=0.3)
    return loss


def make_bcq_loss(
    *,
    perturbation: bool = False,
    num_critics: int = 2,
    critics: Any = None,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    edit: Edit = unchanged,
    **options: Any,
) -> BCQLoss:
    """A small loss whose target networks differ from the trained ones."""
    torch.manual_seed(seed)
    loss = BCQLoss(
        make_generator(dtype, edit),
        make_critics(num_critics, dtype, edit) if critics is None else critics,
        make_perturbation(dtype, edit) if perturbation else None,
        **{"bounds": (-1.0, 1.0), **options},
    )
    return with_moved_targets(loss)


def guide() -> ModuleType:
    """The code of docs/extending.md as a module, so that what it defines can be pickled."""
    if "extending" not in sys.modules:
        page = Path(__file__).parents[1] / "docs" / "extending.md"
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
        sys.modules["extending"] = module = ModuleType("extending")
        exec(compile("\n".join(blocks), page.name, "exec"), vars(module))
    return sys.modules["extending"]


def make_emaq_loss(
    *,
    num_critics: int = 2,
    critics: Any = None,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    edit: Edit = unchanged,
    **options: Any,
) -> GenerativeLoss:
    """The loss that docs/extending.md builds, small, its targets apart from what is trained."""
    build = guide().EMaQLoss  # draws random numbers when it runs for the first time
    torch.manual_seed(seed)
    loss = build(
        make_generator(dtype, edit),
        make_critics(num_critics, dtype, edit) if critics is None else critics,
        **{"bounds": (-1.0, 1.0), **options},
    )
    return with_moved_targets(loss)


def make_plas_loss(
    *,
    perturbation: bool = False,
    num_critics: int = 2,
    critics: Any = None,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    edit: Edit = unchanged,
    **options: Any,
) -> PLASLoss:
    """A small loss whose target networks differ from the trained ones."""
    torch.manual_seed(seed)
    loss = PLASLoss(
        make_generator(dtype, edit),
        edit(make_latent_actor(OBSERVATION_DIM, LATENT_DIM, num_cells=CELLS).to(dtype)),
        make_critics(num_critics, dtype, edit) if critics is None else critics,
        make_perturbation(dtype, edit) if perturbation else None,
        **{"bounds": (-1.0, 1.0), **options},
    )
    return with_moved_targets(loss)


def make_discrete_network(out_key: str, dtype: torch.dtype) -> TensorDictModule:
    """One number per action from the observation."""
    network = MLP(OBSERVATION_DIM, NUM_ACTIONS, num_cells=list(CELLS), activation_class=nn.ReLU)
    return TensorDictModule(network.to(dtype), in_keys=["observation"], out_keys=[out_key])


def make_discrete_bcq_loss(
    *,
    num_critics: int = 2,
    critics: Any = None,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    edit: Edit = unchanged,
    **options: Any,
) -> DiscreteBCQLoss:
    """A small loss whose target networks differ from the trained ones."""
    torch.manual_seed(seed)
    generator = edit(make_discrete_network("logits", dtype))
    if critics is None:
        critics = [edit(make_discrete_network("action_value", dtype)) for _ in range(num_critics)]
    return with_moved_targets(DiscreteBCQLoss(generator, critics, **options))


def make_policy(
    dtype: torch.dtype, in_key: NestedKey = "observation", out_key: NestedKey = "action"
) -> TensorDictModule:
    """A small deterministic policy."""
    network = nn.Sequential(make_mlp(OBSERVATION_DIM, ACTION_DIM, CELLS), nn.Tanh()).to(dtype)
    return TensorDictModule(network, in_keys=[in_key], out_keys=[out_key])


def make_fqe_loss(
    *,
    policy: Any = None,
    num_critics: int = 2,
    critics: Any = None,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    edit: Edit = unchanged,
    **options: Any,
) -> FQELoss:
    """A small loss whose target networks differ from the trained ones; the policy is not edited."""
    torch.manual_seed(seed)
    if critics is None:
        critics = make_critics(num_critics, dtype, edit)
    if policy is None:
        # Under the keys of the edited critics.
        first = critics[0] if isinstance(critics, list) and critics else critics
        policy = make_policy(dtype, *(first.in_keys if first else []))
    return with_moved_targets(FQELoss(policy, critics, **options))


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
    *,
    num_tasks: int = 3,
    teachers: Any = None,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    edit: Edit = unchanged,
    **options: Any,
) -> MetaDistillationLoss:
    """A small loss with teachers of its own."""
    torch.manual_seed(seed)
    student = make_student_networks(num_tasks, dtype)
    generators, critics = teachers or make_teachers(num_tasks, dtype)
    return MetaDistillationLoss(
        *map(edit, student),
        list(map(edit, generators)),
        list(map(edit, critics)),
        **{"latent_dim": LATENT_DIM, "context": "current", **options},
    )


# -- what a loss returns, and what it is made of ---------------------------------------------------


def run(loss: LossModule, data: TensorDict, seed: int = 0) -> TensorDict:
    """The losses for one fixed draw of everything that is random."""
    torch.manual_seed(seed)
    return loss(data)


def total(losses: TensorDict, *terms: str) -> Tensor:
    """Sum of the named terms, or of all."""
    keys = [f"loss_{term}" for term in terms] or sorted(losses.keys())
    return sum(losses[key] for key in keys if key.startswith("loss_"))


def state(module: nn.Module) -> dict[str, Tensor]:
    """A copy of the state_dict."""
    return {key: value.clone() for key, value in module.state_dict().items()}


def gradients(loss: LossModule) -> dict[str, Tensor]:
    """Gradient of every parameter, zero for those that have none."""
    return {
        name: torch.zeros_like(p) if p.grad is None else p.grad.clone()
        for name, p in loss.named_parameters()
    }


def reached(loss: LossModule) -> set[str]:
    """Networks that hold a gradient other than zero."""
    return {name.split("_params.")[0] for name, grad in gradients(loss).items() if grad.any()}


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
