"""One update of the meta-distillation agrees with an independent numpy implementation to 1e-9."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import reference
import torch
from helpers import NO_UPDATER
from reference_update import (
    ACTION_DIM,
    LATENT_DIM,
    NOISE_SEED,
    OBSERVATION_DIM,
    ROWS,
    TASK_LATENT_DIM,
    TASKS,
    Differences,
    Network,
    Record,
    differences,
    draws,
    make_critic,
    make_decoder,
    module,
    name_of,
    plain,
    report,
    slope,
    snapshot,
    transitions,
)
from torch import nn

from torchrl_bmrl.objectives import MetaDistillationLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
ALL_TERMS = ("classification", "generator", "direction", "qvalue", "metric")
DISTILLATION = {
    "latent_clip": 0.5,
    "classification_weight": 0.7,
    "generator_weight": 1.3,
    "direction_weight": 0.9,
    "qvalue_weight": 1.1,
    "latent_norm_weight": 0.05,
    "metric_weight": 0.0,
    "metric_margin": 1.0,
    "encoder_terms": ALL_TERMS,
}
DISTILLATION_VARIANTS = [
    {},
    {"latent_clip": None},
    {"metric_weight": 0.6},
    {"encoder_terms": ("classification",), "metric_weight": 0.6},
    {"encoder_terms": ("generator", "metric"), "metric_weight": 0.6},
    {"encoder_terms": ("direction", "qvalue")},
]
QVALUE_LOC, QVALUE_SCALE = np.array([0.3, -0.2, 0.5]), np.array([0.8, 1.5, 2.5])


def compare_distillation(
    *, wrong: dict[str, Any] | None = None, **options: Any
) -> tuple[Differences, bool]:
    """The largest differences, and whether the teachers stayed as they were."""
    torch.manual_seed(4)
    transition = 2 * OBSERVATION_DIM + ACTION_DIM + 1
    keys = ["observation", "action", ("next", "reward"), ("next", "observation")]
    teachers = {
        "teacher_generators": [make_decoder() for _ in range(TASKS)],
        "teacher_qvalue_networks": [make_critic() for _ in range(TASKS)],
    }
    loss = MetaDistillationLoss(
        module(Network(transition, TASK_LATENT_DIM), keys, "task_latent"),
        module(nn.Linear(TASK_LATENT_DIM, TASKS), ["task_latent"], "task_logits"),
        make_decoder(TASK_LATENT_DIM),
        make_critic(TASK_LATENT_DIM),
        *teachers.values(),
        latent_dim=LATENT_DIM,
        qvalue_loc=torch.as_tensor(QVALUE_LOC),
        qvalue_scale=torch.as_tensor(QVALUE_SCALE),
        context="current",
        **(DISTILLATION | options),
    )
    data = transitions(TASKS, ROWS)
    data["task"] = torch.arange(TASKS).unsqueeze(-1).expand(TASKS, ROWS).clone()
    frozen = {
        f"{name}.{i}.{key.removeprefix('module.')}": value.numpy().copy()
        for name, networks in teachers.items()
        for i, each in enumerate(networks)
        for key, value in each.state_dict().items()
    }

    library = reference.Update(snapshot(loss))
    held = {key: value.clone() for key, value in loss.state_dict().items() if "teacher" in key}
    arrays = plain(data)
    arrays["reward"] = arrays["reward"][..., None]
    optimizer = torch.optim.SGD(loss.parameters(), lr=reference.LEARNING_RATE)
    torch.manual_seed(NOISE_SEED)
    output = loss(data)
    total = sum(value for key, value in output.items() if key.startswith("loss_"))
    total.backward()
    library.values = {key: value.detach().numpy() for key, value in output.items()}
    library.values |= {"td_error": data["td_error"].numpy(), "loss_total": total.detach().numpy()}
    library.gradients = {"total": snapshot(loss, slope)}
    optimizer.step()
    after = loss.state_dict()
    unchanged = bool(held) and all(torch.equal(value, after[key]) for key, value in held.items())

    noise = draws(latent=(TASKS, ROWS, LATENT_DIM))
    # The triplet's rows are drawn after the latents, as cyclic shifts.
    shift = torch.randint(1, ROWS, (ROWS,)).numpy()
    noise["near_row"] = (np.arange(ROWS) + shift) % ROWS
    shift = torch.randint(1, TASKS, (TASKS, ROWS)).numpy()
    noise["far_task"] = (np.arange(TASKS)[:, None] + shift) % TASKS
    noise["far_row"] = torch.randint(ROWS, (TASKS, ROWS)).numpy()
    normalisation = {"qvalue_loc": QVALUE_LOC, "qvalue_scale": QVALUE_SCALE}
    expected = reference.meta_distillation(
        library.state | frozen,
        arrays,
        noise,
        **(normalisation | DISTILLATION | options | (wrong or {})),
    )
    return differences(library, snapshot(loss), expected), unchanged


@pytest.mark.parametrize("options", DISTILLATION_VARIANTS, ids=name_of)
def test_one_update_of_meta_distillation_is_that_of_the_equations(
    options: dict[str, Any], record_property: Record
) -> None:
    found, teachers_unchanged = compare_distillation(**options)
    assert teachers_unchanged
    report("MetaDistillationLoss", found, record_property)


@pytest.mark.parametrize(
    "wrong",
    [
        {"latent_clip": None},
        {"qvalue_loc": QVALUE_LOC + 0.01},
        {"qvalue_scale": QVALUE_SCALE + 0.01},
        *({f"{name}_weight": 0.61} for name in (*ALL_TERMS, "latent_norm")),
        {"metric_margin": 1.01},
        *(
            {"encoder_terms": tuple(term for term in ALL_TERMS if term != name)}
            for name in ALL_TERMS
        ),
    ],
    ids=name_of,
)
def test_a_slightly_different_meta_distillation_does_not_agree(wrong: dict[str, Any]) -> None:
    found, _ = compare_distillation(metric_weight=0.6, wrong=wrong)
    assert max(found.values()) > 1e-5
