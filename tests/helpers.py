"""Builders that several test files share: small networks, random transitions, plain numpy networks.

Everything is float64, so that an independent numpy computation can be compared closely.
"""

from __future__ import annotations

import re
import sys
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.modules import MLP

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import Autoencoder
from torchrl_bmrl.modules import (
    ActionVAE,
    make_context_encoder,
    make_decoder,
    make_gaussian_actor,
    make_latent_actor,
    make_perturbation_network,
    make_qvalue_network,
    make_reward_models,
    make_task_classifier,
    make_task_encoder,
)
from torchrl_bmrl.modules.generator import make_mlp
from torchrl_bmrl.objectives import (
    BCQLoss,
    DiscreteBCQLoss,
    FOCALLoss,
    FQELoss,
    MBMLLoss,
    MetaDistillationLoss,
    PLASLoss,
    RewardModelLoss,
    StackedLoss,
)
from torchrl_bmrl.testing import Case, discrete_transitions, transitions
from torchrl_bmrl.testing.measures import as_keywords as as_keywords
from torchrl_bmrl.testing.measures import reached as reached
from torchrl_bmrl.testing.measures import run as run
from torchrl_bmrl.testing.measures import state as state
from torchrl_bmrl.testing.measures import total as total

OBSERVATION_DIM, ACTION_DIM, LATENT_DIM, TASK_LATENT_DIM = 3, 2, 4, 2
DIMS = (OBSERVATION_DIM, ACTION_DIM)
NUM_ACTIONS = 3
TASKS, ROWS = 3, 5
CELLS = (8,)
NO_UPDATER = "ignore:No target network updater"


def shown_files(page: Path) -> dict[str, str]:
    """The files that a page shows whole, by name."""
    found = re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", page.read_text(), re.DOTALL)
    return dict(found)


def task_transitions(
    num_tasks: int = TASKS, rows: int = ROWS, dtype: torch.dtype = torch.float64
) -> TensorDict:
    """Random transitions of several tasks, each with the one before it."""
    data = transitions(num_tasks, rows, dtype=dtype)
    data["task"] = torch.arange(num_tasks).unsqueeze(-1).expand(num_tasks, rows).clone()
    data["previous"] = transitions(num_tasks, rows, dtype=dtype, seed=1)
    return data


def refused(message: str) -> Any:
    """Expects the library's error with a message that matches."""
    return pytest.raises(BMRLError, match=message)


def observations(*batch: int) -> TensorDict:
    """Random observations, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(*batch, OBSERVATION_DIM, generator=generator)
    return TensorDict({"observation": observation}, batch_size=batch)


# -- losses, small, as cases of the contract -------------------------------------------------------

Q, XI, M, G = "qvalue_network", "perturbation_network", "task_encoder", "student_generator"
ACTOR = "actor_network"
CRITICS = {"generator": {"generator"}, "qvalue": {Q}}
STUDENT = {
    "classification": {M, "task_classifier"},
    "generator": {M, G},
    "direction": {M, G},
    "qvalue": {M, "student_qvalue_network"},
    "latent_norm": {M},
}
BOUNDS = {"bounds": (-1.0, 1.0)}
CRITIC_KEYS = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}
"""The keys of a critic that a test writes itself."""


def undeclared(module: Any) -> Any:
    """The network as a user writes it, without its sizes and bounds."""
    if isinstance(module, ActionVAE):
        parts = undeclared(module.encoder), undeclared(module.decoder)
        return Autoencoder(*parts, module.latent_dim)
    return TensorDictModule(module.module, module.in_keys, module.out_keys)


def undeclare(name: str, network: Any) -> Any:
    """For ``edit`` of a case: every network :func:`undeclared`."""
    return undeclared(network)


def make_generator(dtype: torch.dtype = torch.float64) -> ActionVAE:
    """A small variational autoencoder."""
    return ActionVAE(*DIMS, num_cells=CELLS).to(dtype)


def make_critics(number: int, dtype: torch.dtype = torch.float64) -> list[TensorDictModule]:
    """Small critics of continuous actions."""
    return [make_qvalue_network(*DIMS, num_cells=CELLS).to(dtype) for _ in range(number)]


def bcq_networks(perturbation: bool) -> dict[str, Any]:
    networks: dict[str, Any] = {"generator": make_generator(), Q: make_critics(1)[0]}
    if perturbation:
        networks[XI] = make_perturbation_network(*DIMS, num_cells=CELLS)
    return networks


def bcq_case(perturbation: bool = False) -> Case:
    trains = CRITICS | ({"perturbation": {XI}} if perturbation else {})
    targets = (Q, XI) if perturbation else (Q,)
    return Case(BCQLoss, partial(bcq_networks, perturbation), trains, targets, BOUNDS)


def make_bcq_loss(*, perturbation: bool = False, **options: Any) -> BCQLoss:
    """A small loss whose target networks differ from the trained ones."""
    return bcq_case(perturbation).make(**options)


def stack_of_bcq(number: int = 2) -> tuple[StackedLoss, TensorDict]:
    """A stack of losses with seeds 0, 1, ..., and a batch of other transitions for each."""
    losses = [make_bcq_loss(seed=seed) for seed in range(number)]
    return StackedLoss(losses), torch.stack([transitions(8, seed=seed) for seed in range(number)])


def plas_networks(perturbation: bool) -> dict[str, Any]:
    actor = make_latent_actor(OBSERVATION_DIM, LATENT_DIM, num_cells=CELLS)
    return bcq_networks(perturbation) | {ACTOR: actor}


def plas_case(perturbation: bool = False) -> Case:
    trains = CRITICS | {"actor": {ACTOR, XI} if perturbation else {ACTOR}}
    targets = (Q, ACTOR, XI) if perturbation else (Q, ACTOR)
    return Case(PLASLoss, partial(plas_networks, perturbation), trains, targets, BOUNDS)


def make_plas_loss(*, perturbation: bool = False, **options: Any) -> PLASLoss:
    """A small loss whose target networks differ from the trained ones."""
    return plas_case(perturbation).make(**options)


def make_discrete_network(out_key: str, dtype: torch.dtype = torch.float64) -> TensorDictModule:
    """One number per action from the observation."""
    network = MLP(OBSERVATION_DIM, NUM_ACTIONS, num_cells=list(CELLS), activation_class=nn.ReLU)
    return TensorDictModule(network.to(dtype), in_keys=["observation"], out_keys=[out_key])


def discrete_networks() -> dict[str, Any]:
    return {"generator": make_discrete_network("logits"), Q: make_discrete_network("action_value")}


def discrete_bcq_case(action_space: str = "one-hot") -> Case:
    option = {"action_space": action_space}
    data = partial(discrete_transitions, **option)
    return Case(DiscreteBCQLoss, discrete_networks, CRITICS, (Q,), option, data)


def make_discrete_bcq_loss(**options: Any) -> DiscreteBCQLoss:
    """A small loss whose target networks differ from the trained ones."""
    return discrete_bcq_case().make(**options)


def make_policy(
    dtype: torch.dtype, in_key: NestedKey = "observation", out_key: NestedKey = "action"
) -> TensorDictModule:
    """A small deterministic policy."""
    network = nn.Sequential(make_mlp(*DIMS, CELLS), nn.Tanh()).to(dtype)
    return TensorDictModule(network, in_keys=[in_key], out_keys=[out_key])


def evaluate_a_policy(qvalue_network: Any, policy: Any = None, **options: Any) -> FQELoss:
    """A loss whose policy reads and writes the critics' keys and is not trained."""
    if policy is None:
        several = isinstance(qvalue_network, list)
        first = next(iter(qvalue_network), None) if several else qvalue_network
        weight = torch.zeros(()) if first is None else next(first.parameters())
        policy = make_policy(weight.dtype, *(first.in_keys if first else []))
    return FQELoss(policy, qvalue_network, **options)


def fqe_case() -> Case:
    return Case(evaluate_a_policy, lambda: {Q: make_critics(1)[0]}, {"qvalue": {Q}}, (Q,))


def make_fqe_loss(**options: Any) -> FQELoss:
    """A small loss whose target networks differ from the trained ones; the policy is not edited."""
    return fqe_case().make(**options)


def make_student_networks(num_tasks: int, dtype: torch.dtype) -> list[TensorDictModule]:
    """Encoder, classifier, generator and critic of a student."""
    networks = [
        make_task_encoder(*DIMS, TASK_LATENT_DIM, num_cells=CELLS),
        make_task_classifier(num_tasks, TASK_LATENT_DIM),
        make_decoder(*DIMS, LATENT_DIM, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS),
        make_qvalue_network(*DIMS, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS),
    ]
    return [network.to(dtype) for network in networks]


def make_teachers(
    num_tasks: int, dtype: torch.dtype = torch.float64
) -> tuple[list[TensorDictModule], list[TensorDictModule]]:
    """One decoder and one critic per task."""
    return (
        [make_decoder(*DIMS, LATENT_DIM, num_cells=CELLS).to(dtype) for _ in range(num_tasks)],
        [make_qvalue_network(*DIMS, num_cells=CELLS).to(dtype) for _ in range(num_tasks)],
    )


def distillation_networks(num_tasks: int = TASKS, teachers: Any = None) -> dict[str, Any]:
    student = make_student_networks(num_tasks, torch.float64)
    names = (M, "task_classifier", G, "student_qvalue_network")
    generators, critics = teachers or make_teachers(num_tasks)
    frozen = {"teacher_generators": generators, "teacher_qvalue_networks": critics}
    return dict(zip(names, student, strict=True)) | frozen


def set_networks(pooling: str = "attention", num_tasks: int = TASKS) -> dict[str, Any]:
    """A student whose encoder reads sets of transitions, and its teachers."""
    encoder = make_context_encoder(
        *DIMS, TASK_LATENT_DIM, pooling=pooling, num_features=6, num_cells=CELLS
    )
    return distillation_networks(num_tasks) | {M: encoder.to(torch.float64)}


def set_transitions(*shape: int, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Random transitions of several tasks, each with one of a context of its task."""
    data = task_transitions(*shape, dtype=dtype)
    given = transitions(*shape, dtype=dtype, seed=2)
    return data.set("context", given.select("observation", "action", "next"))


def distillation_case(
    trains: dict[str, set[str]] = STUDENT,
    *,
    num_tasks: int = TASKS,
    teachers: Any = None,
    sets: bool = False,
    **options: Any,
) -> Case:
    if sets:
        options = {"context_fraction": 1.0, "context_size": 2, **options}
    return Case(
        MetaDistillationLoss,
        set_networks if sets else partial(distillation_networks, num_tasks, teachers),
        trains,
        options={"latent_dim": LATENT_DIM, "context": "current", **options},
        data=set_transitions if sets else task_transitions,
        shape=(TASKS, ROWS),
        need_not_fall=("latent_norm",),  # the penalty on m pays for the other terms
        mixes_rows=options.get("context") in ("random", "set", "given"),
    )


def make_distillation_loss(
    *, num_tasks: int = TASKS, teachers: Any = None, **options: Any
) -> MetaDistillationLoss:
    """A small loss with teachers of its own."""
    return distillation_case(num_tasks=num_tasks, teachers=teachers).make(**options)


def focal_networks() -> dict[str, Any]:
    latent = {"task_latent_dim": TASK_LATENT_DIM, "num_cells": CELLS}
    return {
        M: make_context_encoder(*DIMS, TASK_LATENT_DIM, num_features=4, num_cells=CELLS),
        ACTOR: make_gaussian_actor(*DIMS, **latent),
        "divergence_network": make_qvalue_network(*DIMS, **latent),
        Q: make_qvalue_network(*DIMS, **latent),
    }


def task_data(*shape: int, **options: Any) -> TensorDict:
    """Random transitions with an m, which critics alone can read."""
    data = transitions(*shape, **options)
    data["task_latent"] = transitions(*shape, **options, seed=2)["action"]
    return data


def focal_case(**options: Any) -> Case:
    return Case(
        FOCALLoss,
        focal_networks,
        {
            "encoder": {M},
            "divergence": {"divergence_network"},
            "qvalue": {Q},
            "actor": {ACTOR},
        },
        (Q,),
        BOUNDS | {"context_size": 2, "divergence_weight": 1.0} | options,
        task_data,
        shape=(TASKS, 6),
        need_not_fall=("actor", "divergence"),
        mixes_rows=True,
        by_task=True,
    )


def make_focal_loss(**options: Any) -> FOCALLoss:
    """A small loss whose target networks differ from the trained ones."""
    return focal_case().make(**options)


def reward_models_case() -> Case:
    def networks() -> dict[str, Any]:
        return {"reward_models": make_reward_models(TASKS, *DIMS, num_models=4, num_cells=CELLS)}

    trains = {"reward": {"reward_models"}}
    return Case(RewardModelLoss, networks, trains, data=task_transitions, shape=(TASKS, ROWS))


def mbml_networks() -> dict[str, Any]:
    networks = distillation_networks() | reward_models_case().networks()
    del networks["task_classifier"]
    sizes = {"num_features": 4, "num_cells": CELLS}
    return networks | {M: make_context_encoder(*DIMS, TASK_LATENT_DIM, **sizes)}


def mbml_case(**options: Any) -> Case:
    return Case(
        MBMLLoss,
        mbml_networks,
        {
            "generator": {G},
            "direction": {G},
            "qvalue": {M, "student_qvalue_network"},
            "latent_norm": {M},
            "triplet": {M},
        },
        options={
            "latent_dim": LATENT_DIM,
            "context_size": 2,
            "max_deviation": 10.0,
            "direction_weight": 1.0,
            **options,
        },
        data=task_transitions,
        shape=(TASKS, ROWS),
        need_not_fall=("latent_norm", "triplet"),
        mixes_rows=True,
    )


def make_mbml_loss(**options: Any) -> MBMLLoss:
    """A small loss with teachers of its own and untrained reward models."""
    return mbml_case().make(**options)


def guide(name: str = "extending") -> ModuleType:
    """The code of a page of docs/ as a module, so that what it defines can be pickled."""
    if name not in sys.modules:
        page = Path(__file__).parents[1] / "docs" / f"{name}.md"
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
        sys.modules[name] = module = ModuleType(name)
        exec(compile("\n".join(blocks), page.name, "exec"), vars(module))
    return sys.modules[name]
