"""The terms of MetaDistillationLoss are those of the equations and train the chosen networks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    LATENT_DIM,
    ROWS,
    TASKS,
    make_distillation_loss,
    make_student_networks,
    make_teachers,
    reached,
    run,
    task_transitions,
    total,
)
from recomputed import numpy_decoder, numpy_mlp, recorded
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import MetaDistillationLoss

Teachers = tuple[list[TensorDictModule], list[TensorDictModule]]
LOC, SCALE = np.array([0.5, -1.0, 2.0]), np.array([1.0, 4.0, 0.5])
NORMALISATION = {"qvalue_loc": torch.as_tensor(LOC), "qvalue_scale": torch.as_tensor(SCALE)}
TERMS = ("classification", "generator", "direction", "qvalue", "latent_norm")
ENCODER_TERMS = ("classification", "generator", "direction", "qvalue", "metric")


# -- the terms -------------------------------------------------------------------------------------


def expected_terms(
    loss: MetaDistillationLoss,
    teachers: Teachers,
    data: TensorDict,
    latent: Tensor,
    transition: TensorDict,
) -> dict[str, np.ndarray]:
    """The unweighted terms of every row in numpy, for given action latents."""
    observation = data["observation"].numpy()
    m = numpy_mlp(
        loss.task_encoder_params["module"],
        *(transition[key] for key in loss.task_encoder.in_keys),
    )
    classifier = loss.task_classifier_params["module"]
    logits = m @ classifier["weight"].detach().numpy().T + classifier["bias"].detach().numpy()
    probability = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    generators, critics = ([TensorDict.from_module(x) for x in group] for group in teachers)
    target = np.stack(list(map(numpy_decoder, generators, observation, latent)))
    target_value = np.stack(
        [numpy_mlp(q["module"], *row) for q, *row in zip(critics, observation, target, strict=True)]
    )[..., 0]
    target_value = (target_value - LOC[:, None]) / SCALE[:, None]
    action = numpy_decoder(loss.student_generator_params, observation, latent, m)
    value = numpy_mlp(loss.student_qvalue_network_params["module"], observation, action, m)[..., 0]
    task = data["task"].numpy()[..., None]
    lengths = np.linalg.norm(action, axis=-1) * np.linalg.norm(target, axis=-1)
    return {
        "classification": -np.log(np.take_along_axis(probability, task, -1))[..., 0],
        "generator": ((action - target) ** 2).sum(-1),
        "direction": 1 - (action * target).sum(-1) / lengths,
        "qvalue": (value - target_value) ** 2,
        "latent_norm": (m**2).sum(-1),
    }


@pytest.mark.parametrize("deactivate_vmap", [False, True])
@pytest.mark.parametrize("context", ["current", "previous"])
def test_terms_are_those_of_the_equations(context: str, deactivate_vmap: bool) -> None:
    weights = dict(zip(TERMS, (0.5, 2.0, 3.0, 0.25, 0.01), strict=True))
    torch.manual_seed(1)
    teachers = make_teachers(TASKS)
    loss = make_distillation_loss(
        teachers=teachers,
        context=context,
        context_fraction=1.0,
        reduction="none",
        latent_clip=None,
        deactivate_vmap=deactivate_vmap,
        **NORMALISATION,
        **{f"{name}_weight": weight for name, weight in weights.items()},
    )
    data = task_transitions()
    calls = recorded(loss.student_generator.module)
    losses = loss(data)
    ((_, latent, _), _), *_ = calls
    assert latent.shape == (TASKS, ROWS, LATENT_DIM)
    assert len(latent.flatten(0, 1).unique(dim=0)) == TASKS * ROWS
    # The expected terms use the z that the student decoded, and teacher i for row i.
    transition = data["previous"] if context == "previous" else data
    terms = expected_terms(loss, teachers, data, latent, transition)
    for name, weight in weights.items():
        assert losses[f"loss_{name}"].shape == (TASKS, ROWS)
        np.testing.assert_allclose(
            losses[f"loss_{name}"].detach(), weight * terms[name], rtol=1e-8, err_msg=name
        )
    np.testing.assert_allclose(losses["latent_norm"], np.sqrt(terms["latent_norm"].mean()))


def test_swapped_teachers_change_the_targets_with_them() -> None:
    generators, critics = make_teachers(TASKS)
    values = []
    for order in ([0, 1, 2], [2, 0, 1]):
        teachers = [generators[i] for i in order], [critics[i] for i in order]
        loss = make_distillation_loss(teachers=teachers, reduction="none", **NORMALISATION)
        data = task_transitions()
        calls = recorded(loss.student_generator.module)
        losses = loss(data)
        terms = expected_terms(loss, teachers, data, calls[0][0][1], data)
        for name in ("generator", "qvalue"):
            np.testing.assert_allclose(losses[f"loss_{name}"].detach(), terms[name], rtol=1e-8)
        values.append(losses)
    for name in ("generator", "direction", "qvalue"):
        assert (values[0][f"loss_{name}"] != values[1][f"loss_{name}"]).all()
    assert torch.equal(values[0]["loss_classification"], values[1]["loss_classification"])


@pytest.mark.parametrize("clip", [0.5, None])
def test_latents_are_clipped_only_if_asked(clip: float | None) -> None:
    loss = make_distillation_loss(latent_clip=clip)
    calls = recorded(loss.student_generator.module)
    loss(task_transitions(TASKS, 50))
    largest = calls[0][0][1].abs().max()
    assert largest > 2 if clip is None else largest == 0.5


def test_student_is_judged_at_its_own_action_and_the_teacher_at_its() -> None:
    loss = make_distillation_loss(deactivate_vmap=True)
    student, judged = (
        recorded(loss.student_generator.module),
        recorded(loss.student_qvalue_network.module),
    )
    taught, valued = (
        recorded(loss.teacher_generators.modules_[0].module),
        recorded(loss.teacher_qvalue_networks.modules_[0].module),
    )
    loss(task_transitions())
    assert torch.equal(judged[0][0][1], student[0][1])
    assert len(taught) == TASKS
    for (_, action), ((_, seen), _) in zip(taught, valued, strict=True):
        assert torch.equal(seen, action)


def test_accuracy_is_the_share_of_rows_that_are_classified_right() -> None:
    loss = make_distillation_loss()
    for value in loss.task_classifier_params.values(True, True):
        value.data.zero_()
    loss.task_classifier_params["module", "bias"].data[1] = 1.0
    assert loss(task_transitions())["accuracy"].item() == pytest.approx(1 / TASKS)


def test_priority_is_the_sum_of_a_row_s_terms() -> None:
    loss, data = make_distillation_loss(reduction="none", metric_weight=0.5), task_transitions()
    losses = run(loss, data)
    torch.testing.assert_close(data["td_error"], total(losses).detach())


# -- gradients -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "terms",
    [(), *((term,) for term in ENCODER_TERMS), ("generator", "qvalue"), ENCODER_TERMS],
    ids="-".join,
)
def test_the_chosen_terms_alone_train_the_encoder(terms: tuple[str, ...]) -> None:
    loss = make_distillation_loss(encoder_terms=terms, metric_weight=0.5)
    losses = run(make_distillation_loss(metric_weight=0.5), task_transitions())
    assert (run(loss, task_transitions()) == losses).all()
    own = {
        "classification": {"task_classifier"},
        "generator": {"student_generator"},
        "direction": {"student_generator"},
        "qvalue": {"student_qvalue_network"},
        "metric": set(),
        "latent_norm": set(),
    }
    for term, networks in own.items():
        trained = {"task_encoder"} if term in (*terms, "latent_norm") else set()
        loss.zero_grad()
        value = run(loss, task_transitions())[f"loss_{term}"]
        assert value.requires_grad == bool(networks | trained)
        if value.requires_grad:
            value.backward()
        assert reached(loss) == networks | trained, term


def test_the_networks_given_as_the_student_are_trained_in_place() -> None:
    networks = make_student_networks(TASKS, torch.float64)
    loss = MetaDistillationLoss(
        *networks, *make_teachers(TASKS), latent_dim=LATENT_DIM, context="current"
    )
    total(loss(task_transitions())).backward()
    torch.optim.SGD(loss.parameters(), lr=1.0).step()
    own = {id(p): p for network in networks for p in network.parameters()}
    trained = {id(p): p for p in loss.parameters()}
    assert own.keys() == trained.keys()


# -- arguments -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda task: task.float(), r"'task' is torch.float32; valid: torch.int64"),
        (lambda task: task + 1, "'task' holds 3; valid: 0 to 2"),
    ],
)
def test_tasks_that_are_no_class_index_are_refused(change: Any, message: str) -> None:
    data = task_transitions()
    data["task"] = change(data["task"])
    with pytest.raises(BMRLError, match=message):
        make_distillation_loss()(data)


def test_scales_of_the_values_are_checked() -> None:
    with pytest.raises(BMRLError, match=r"qvalue_scale is .*above 0"):
        make_distillation_loss(qvalue_scale=torch.zeros(TASKS))
    with pytest.raises(BMRLError, match=r"qvalue_loc is .*each of the 3 tasks"):
        make_distillation_loss(qvalue_loc=torch.zeros(2))
