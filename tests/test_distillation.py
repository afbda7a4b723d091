"""MetaDistillationLoss: its terms, its contexts, and where its gradients go."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    LATENT_DIM,
    as_keywords,
    make_distillation_loss,
    make_student_networks,
    make_teachers,
    numpy_decoder,
    numpy_mlp,
    recorded,
    task_transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import MetaDistillationLoss

Teachers = tuple[list[TensorDictModule], list[TensorDictModule]]
TASKS, ROWS = 3, 5
LOC, SCALE = np.array([0.5, -1.0, 2.0]), np.array([1.0, 4.0, 0.5])
NORMALISATION = {"qvalue_loc": torch.as_tensor(LOC), "qvalue_scale": torch.as_tensor(SCALE)}
TERMS = ("classification", "generator", "direction", "qvalue", "latent_norm")
CONTEXTS = ("current", "previous", "random", "set")


def total(losses: TensorDict, *names: str) -> Tensor:
    return sum(losses[f"loss_{name}"] for name in names or TERMS)


def gradients(loss: MetaDistillationLoss, *names: str) -> dict[str, Tensor]:
    """Gradient of some terms at each parameter, for the same latents."""
    loss.zero_grad()
    torch.manual_seed(0)
    total(loss(task_transitions(TASKS, ROWS)), *names).backward()
    return {
        name: torch.zeros_like(p) if p.grad is None else p.grad.clone()
        for name, p in loss.named_parameters()
    }


def networks_of(grads: dict[str, Tensor]) -> set[str]:
    return {name.split("_params")[0] for name, grad in grads.items() if grad.any()}


def expected_terms(
    loss: MetaDistillationLoss,
    teachers: Teachers,
    data: TensorDict,
    latent: Tensor,
    transition: TensorDict,
) -> dict[str, np.ndarray]:
    """The terms per row without their weights, in numpy, for given action latents."""
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


# -- the terms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("deactivate_vmap", [False, True])
@pytest.mark.parametrize("context", ["current", "previous"])
def test_terms_are_those_of_the_equations(context: str, deactivate_vmap: bool) -> None:
    weights = dict(zip(TERMS, (0.5, 2.0, 3.0, 0.25, 0.01), strict=True))
    torch.manual_seed(0)
    teachers = make_teachers(TASKS)
    loss = MetaDistillationLoss(
        *make_student_networks(TASKS, torch.float64),
        *teachers,
        latent_dim=LATENT_DIM,
        context=context,
        context_fraction=1.0,
        reduction="none",
        latent_clip=None,
        deactivate_vmap=deactivate_vmap,
        **NORMALISATION,
        **{f"{name}_weight": weight for name, weight in weights.items()},
    )
    data = task_transitions(TASKS, ROWS)
    calls = recorded(loss.student_generator.module)
    losses = loss(data)
    ((_, latent, _), _), *_ = calls
    assert latent.shape == (TASKS, ROWS, LATENT_DIM)
    assert len(latent.flatten(0, 1).unique(dim=0)) == TASKS * ROWS
    # The teachers are recomputed from the student's z: the same for both, and teacher i in row i.
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
        torch.manual_seed(0)
        teachers = [generators[i] for i in order], [critics[i] for i in order]
        loss = MetaDistillationLoss(
            *make_student_networks(TASKS, torch.float64),
            *teachers,
            latent_dim=LATENT_DIM,
            context="current",
            reduction="none",
            **NORMALISATION,
        )
        data = task_transitions(TASKS, ROWS)
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
        recorded(loss._teacher_generator.module),
        recorded(loss._teacher_qvalue_network.module),
    )
    loss(task_transitions(TASKS, ROWS))
    assert torch.equal(judged[0][0][1], student[0][1])
    for (_, action), ((_, seen), _) in zip(taught, valued, strict=True):
        assert torch.equal(seen, action)


def test_accuracy_is_the_share_of_rows_that_are_classified_right() -> None:
    loss = make_distillation_loss()
    for value in loss.task_classifier_params.values(True, True):
        value.data.zero_()
    loss.task_classifier_params["module", "bias"].data[1] = 1.0
    assert loss(task_transitions(TASKS, ROWS))["accuracy"].item() == pytest.approx(1 / TASKS)


# -- gradients ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("term", "networks"),
    [
        ("classification", {"task_encoder", "task_classifier"}),
        ("generator", {"task_encoder", "student_generator"}),
        ("direction", {"task_encoder", "student_generator"}),
        ("qvalue", {"task_encoder", "student_qvalue_network"}),
        ("latent_norm", {"task_encoder"}),
    ],
)
def test_a_term_sends_gradients_to_its_networks_alone(term: str, networks: set[str]) -> None:
    assert networks_of(gradients(make_distillation_loss(), term)) == networks
    detached = make_distillation_loss(detach_task_latent=True)
    if term not in ("classification", "latent_norm"):
        networks = networks - {"task_encoder"}
    assert networks_of(gradients(detached, term)) == networks


def test_with_a_detached_embedding_cross_entropy_alone_trains_the_encoder() -> None:
    loss = make_distillation_loss(detach_task_latent=True, latent_norm_weight=0.0)
    whole, alone = gradients(loss), gradients(loss, "classification")
    encoder = [name for name in whole if name.startswith("task_encoder_params")]
    assert all(torch.equal(whole[name], alone[name]) for name in encoder)
    attached = gradients(make_distillation_loss(latent_norm_weight=0.0))
    assert not any(torch.equal(attached[name], alone[name]) for name in encoder)


def test_teachers_are_no_parameters_and_do_not_change() -> None:
    generators, critics = make_teachers(TASKS)
    before = [p.detach().clone() for module in (*generators, *critics) for p in module.parameters()]
    loss = MetaDistillationLoss(
        *make_student_networks(TASKS, torch.float64),
        generators,
        critics,
        latent_dim=LATENT_DIM,
        context="current",
    )
    assert not any("teacher" in name for name, _ in loss.named_parameters())
    buffers = {name: b.clone() for name, b in loss.named_buffers() if "teacher" in name}
    optimizer = torch.optim.SGD(loss.parameters(), lr=1.0)
    total(loss(task_transitions(TASKS, ROWS))).backward()
    optimizer.step()
    after = [p for module in (*generators, *critics) for p in module.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert all(p.grad is None for p in after)
    now = dict(loss.named_buffers())
    assert len(buffers) == 10  # weights and biases of two layers twice, and the decoders' bounds
    assert all(torch.equal(now[name], value) for name, value in buffers.items())


def test_teachers_are_copies() -> None:
    generators, critics = make_teachers(TASKS)
    torch.manual_seed(0)
    loss = MetaDistillationLoss(
        *make_student_networks(TASKS, torch.float64),
        generators,
        critics,
        latent_dim=LATENT_DIM,
        context="current",
    )
    results = []
    for _ in range(2):
        torch.manual_seed(1)
        results.append(loss(task_transitions(TASKS, ROWS)))
        for module in (*generators, *critics):
            for parameter in module.parameters():
                parameter.data.add_(1.0)
    assert (results[0] == results[1]).all()


def test_the_networks_given_as_the_student_are_trained_in_place() -> None:
    networks = make_student_networks(TASKS, torch.float64)
    loss = MetaDistillationLoss(
        *networks, *make_teachers(TASKS), latent_dim=LATENT_DIM, context="current"
    )
    total(loss(task_transitions(TASKS, ROWS))).backward()
    torch.optim.SGD(loss.parameters(), lr=1.0).step()
    own = {id(p): p for network in networks for p in network.parameters()}
    trained = {id(p): p for p in loss.parameters()}
    assert own.keys() == trained.keys()


def test_student_overfits_one_batch() -> None:
    loss = make_distillation_loss(dtype=torch.float32, qvalue_scale=torch.full((TASKS,), 0.5))
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-2)
    data = task_transitions(TASKS, ROWS, dtype=torch.float32)
    history = []
    for _ in range(200):
        losses = loss(data)
        optimizer.zero_grad()
        total(losses).backward()
        optimizer.step()
        history.append(losses.detach())
    first, last = history[0], torch.stack(history[-10:]).mean(0)
    assert last["accuracy"] == 1.0
    for name in ("classification", "generator", "direction", "qvalue"):
        assert last[f"loss_{name}"] < 0.3 * first[f"loss_{name}"], name


# -- where m comes from ------------------------------------------------------------------------


def encode(loss: MetaDistillationLoss, transition: TensorDict) -> Tensor:
    keys = loss.task_encoder.in_keys
    return loss.task_encoder(transition.select(*keys))["task_latent"]


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
def test_previous_context_embeds_the_previous_transition_on_the_chosen_share(
    fraction: float,
) -> None:
    loss = make_distillation_loss(context="previous", context_fraction=fraction)
    data = task_transitions(TASKS, 400)
    latent = loss.embed(data)
    current = (latent == encode(loss, data)).all(-1)
    previous = (latent == encode(loss, data["previous"])).all(-1)
    assert (current ^ previous).all()
    for row in previous.double().mean(-1):
        assert row.item() == pytest.approx(fraction, abs=0.1)


def identity_loss(context: str, **options: Any) -> MetaDistillationLoss:
    """Its encoder returns the observation, so that an embedding tells which rows it is made of."""
    _, classifier, generator, critic = make_student_networks(TASKS, torch.float64)
    encoder = TensorDictModule(
        lambda observation: observation, in_keys=["observation"], out_keys=["task_latent"]
    )
    return MetaDistillationLoss(
        encoder,
        classifier,
        generator,
        critic,
        *make_teachers(TASKS),
        latent_dim=LATENT_DIM,
        context=context,
        context_fraction=1.0,
        **options,
    )


def one_hot_rows(rows: int) -> TensorDict:
    """Row b of task i observes 1 at place b of block i and 0 elsewhere."""
    eye = torch.eye(TASKS * rows, dtype=torch.float64).view(TASKS, rows, TASKS * rows)
    return TensorDict({"observation": eye}, batch_size=[TASKS, rows])


@pytest.mark.parametrize(("context", "size"), [("random", 1), ("set", 4)])
def test_context_rows_are_rows_of_the_same_task(context: str, size: int) -> None:
    rows = 40
    torch.manual_seed(0)
    latent = identity_loss(context, context_size=4).embed(one_hot_rows(rows))
    counts = (size * latent).view(TASKS, rows, TASKS, rows)  # task, row, task and row it is made of
    assert torch.equal(counts, counts.round())
    assert counts.min() == 0
    for i in range(TASKS):
        assert torch.equal(counts[i, :, i].sum(-1), torch.full((rows,), float(size)).double())
        made_of = counts[i, :, i]
        assert made_of.diagonal().mean() < 0.3 * size  # another row than its own
        assert (made_of.sum(0) > 0).double().mean() > 0.5  # all over the task's rows


def test_current_context_is_the_paper_s_and_needs_no_previous_transition() -> None:
    loss = make_distillation_loss(context="current")
    data = task_transitions(TASKS, ROWS).exclude("previous")
    assert torch.equal(loss.embed(data), encode(loss, data))
    assert not any("previous" in key for key in loss.in_keys)
    loss(data)


def test_data_without_the_previous_transition_are_refused_by_name() -> None:
    loss = make_distillation_loss(context="previous")
    data = task_transitions(TASKS, ROWS).exclude("previous")
    with pytest.raises(BMRLError, match=r"no 'previous'.*valid: .*with_previous"):
        loss(data)
    loss.set_keys(previous="before")
    with pytest.raises(BMRLError, match="no 'before'"):
        loss(task_transitions(TASKS, ROWS))


# -- TorchRL's contract ------------------------------------------------------------------------


@pytest.mark.parametrize("context", CONTEXTS)
def test_keyword_dispatch_returns_the_out_keys_in_order(context: str) -> None:
    loss = make_distillation_loss(context=context)
    data = task_transitions(TASKS, ROWS)
    torch.manual_seed(0)
    expected = loss(data)
    assert set(expected.keys()) == set(loss.out_keys)
    torch.manual_seed(0)
    result = loss(**as_keywords(data, loss.in_keys))
    for key, value in zip(loss.out_keys, result, strict=True):
        assert torch.equal(value, expected[key]), key


@pytest.mark.parametrize("context", CONTEXTS)
def test_forward_leaves_the_input_and_detaches_what_is_no_loss(context: str) -> None:
    loss = make_distillation_loss(context=context)
    data = task_transitions(TASKS, ROWS)
    before = data.clone()
    for key, value in loss(data).items():
        assert value.requires_grad == key.startswith("loss_")
    assert set(data.keys(True)) == set(before.keys(True))
    assert (data == before).all()


def test_select_out_keys_keeps_only_those() -> None:
    loss = make_distillation_loss()
    loss.select_out_keys("loss_generator")
    assert list(loss(task_transitions(TASKS, ROWS)).keys()) == ["loss_generator"]
    assert len(make_distillation_loss().out_keys) == 7


def test_renamed_keys_give_the_same_losses() -> None:
    loss = make_distillation_loss(context="previous")
    data = task_transitions(TASKS, ROWS)
    torch.manual_seed(0)
    expected = loss(data)
    loss.set_keys(task=("info", "class"), previous=("info", "before"))
    data["info"] = TensorDict(
        {"class": data.pop("task"), "before": data.pop("previous")}, data.shape
    )
    assert ("info", "before", "next", "reward") in loss.in_keys
    torch.manual_seed(0)
    assert (loss(data) == expected).all()
    torch.manual_seed(0)
    result = loss(**as_keywords(data, loss.in_keys))
    assert torch.equal(result[0], expected["loss_classification"])


def test_state_dict_round_trip_brings_teachers_and_student_along() -> None:
    loss, other = make_distillation_loss(), make_distillation_loss(seed=1)
    before = set(loss.state_dict())
    loss(task_transitions(TASKS, ROWS))
    assert set(loss.state_dict()) == before
    other.load_state_dict(deepcopy(loss.state_dict()), strict=True)
    copy = deepcopy(loss)
    results = []
    for module in (loss, other, copy):
        torch.manual_seed(0)
        results.append(module(task_transitions(TASKS, ROWS)))
    assert (results[0] == results[1]).all()
    assert (results[0] == results[2]).all()
    total(results[2]).backward()
    assert all(p.grad is None for p in loss.parameters())


@pytest.mark.parametrize("term", TERMS)
def test_reductions_masks_and_priority_weights_agree(term: str) -> None:
    loss, key = make_distillation_loss(), f"loss_{term}"
    data = task_transitions(TASKS, ROWS)

    def value(reduction: str) -> Tensor:
        loss.reduction = reduction
        torch.manual_seed(0)
        return loss(data)[key]

    rows = value("none")
    assert rows.shape == (TASKS, ROWS)
    torch.testing.assert_close(value("sum"), rows.sum())
    torch.testing.assert_close(value("mean"), rows.mean())
    mask = torch.arange(ROWS).expand(TASKS, ROWS) != 1
    data["collector", "mask"] = mask
    torch.testing.assert_close(value("mean"), rows[mask].mean())
    del data["collector"]
    weight = torch.linspace(0.1, 1, TASKS * ROWS, dtype=torch.float64).view(TASKS, ROWS)
    data["priority_weight"] = weight
    torch.testing.assert_close(value("mean"), (rows * weight).sum() / weight.sum())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_losses_have_the_dtype_of_networks_and_data(dtype: torch.dtype) -> None:
    losses = make_distillation_loss(dtype=dtype)(task_transitions(TASKS, ROWS, dtype=dtype))
    assert {value.dtype for value in losses.values()} == {dtype}


# -- arguments ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(ROWS,), (TASKS + 1, ROWS), (TASKS, ROWS, 1)])
def test_data_that_are_not_one_row_per_teacher_are_refused(shape: tuple[int, ...]) -> None:
    data = TensorDict({"observation": torch.zeros(*shape, 3)}, batch_size=shape)
    with pytest.raises(BMRLError, match=r"valid: \[3, B\], one row per teacher"):
        make_distillation_loss()(data)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"context": "next"}, "'next'; valid .*: current, previous, random, set"),
        ({"context_fraction": 1.5}, "context_fraction is 1.5; valid: between 0 and 1"),
        ({"context_size": 0}, "context_size is 0; valid: at least 1"),
    ],
)
def test_bad_options_are_refused_with_the_valid_values(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(BMRLError, match=message):
        make_distillation_loss(**options)


def test_as_many_generators_as_critics_are_needed() -> None:
    generators, critics = make_teachers(TASKS)
    with pytest.raises(BMRLError, match="3 teacher_generators and 2 teacher_qvalue_networks"):
        MetaDistillationLoss(
            *make_student_networks(TASKS, torch.float64),
            generators,
            critics[:2],
            latent_dim=LATENT_DIM,
        )
