"""MetaDistillationLoss: its terms, its contexts, and where its gradients go."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    LATENT_DIM,
    NO_UPDATER,
    make_distillation_loss,
    make_plas_loss,
    make_student_networks,
    make_teachers,
    numpy_decoder,
    numpy_mlp,
    reached,
    recorded,
    run,
    task_transitions,
    total,
    undeclared,
)
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import triplet_error
from torchrl_bmrl.modules import PLASPolicy, make_decoder, make_qvalue_network
from torchrl_bmrl.objectives import MetaDistillationLoss
from torchrl_bmrl.objectives.task_rows import draw_others

Teachers = tuple[list[TensorDictModule], list[TensorDictModule]]
TASKS, ROWS = 3, 5
LOC, SCALE = np.array([0.5, -1.0, 2.0]), np.array([1.0, 4.0, 0.5])
NORMALISATION = {"qvalue_loc": torch.as_tensor(LOC), "qvalue_scale": torch.as_tensor(SCALE)}
TERMS = ("classification", "generator", "direction", "qvalue", "latent_norm")
ENCODER_TERMS = ("classification", "generator", "direction", "qvalue", "metric")


def batch() -> TensorDict:
    return task_transitions(TASKS, ROWS)


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
    data = batch()
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
        data = batch()
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
    loss(batch())
    assert torch.equal(judged[0][0][1], student[0][1])
    for (_, action), ((_, seen), _) in zip(taught, valued, strict=True):
        assert torch.equal(seen, action)


def test_accuracy_is_the_share_of_rows_that_are_classified_right() -> None:
    loss = make_distillation_loss()
    for value in loss.task_classifier_params.values(True, True):
        value.data.zero_()
    loss.task_classifier_params["module", "bias"].data[1] = 1.0
    assert loss(batch())["accuracy"].item() == pytest.approx(1 / TASKS)


def test_priority_is_the_sum_of_a_row_s_terms() -> None:
    loss, data = make_distillation_loss(reduction="none", metric_weight=0.5), batch()
    losses = run(loss, data)
    torch.testing.assert_close(data["td_error"], total(losses).detach())


# -- the metric term ---------------------------------------------------------------------------


def test_metric_term_is_the_triplet_error_of_rows_of_the_same_and_another_task(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []

    def spy(*inputs: Any) -> Tensor:
        calls.append(inputs)
        return triplet_error(*inputs)

    monkeypatch.setattr("torchrl_bmrl.functional.triplet_error", spy)
    loss = make_distillation_loss(metric_weight=0.5, metric_margin=0.3, reduction="none")
    data = task_transitions(TASKS, 20)
    value = run(loss, data)["loss_metric"].detach().numpy()
    anchor, near, away = (x.detach().numpy() for x in calls[0][:3])
    m = encode(loss, data).detach().numpy()
    assert np.array_equal(anchor, m)

    def origin(row: np.ndarray) -> tuple[int, int]:
        ((task, index),) = np.argwhere((m == row).all(-1))
        return task, index

    for task, index in np.ndindex(TASKS, 20):
        same, other = origin(near[task, index]), origin(away[task, index])
        assert same[0] == task
        assert same[1] != index
        assert other[0] != task
    assert {origin(away[0, index])[0] for index in range(20)} == {1, 2}
    distance = [np.linalg.norm(anchor - x, axis=-1) for x in (near, away)]
    expected = 0.5 * np.maximum(0, distance[0] - distance[1] + 0.3)
    assert (expected > 0).any()
    np.testing.assert_allclose(value, expected, atol=1e-5)


def test_metric_term_is_zero_where_the_tasks_lie_far_apart() -> None:
    centre = 10.0 * torch.eye(TASKS, 2, dtype=torch.float64).unsqueeze(1)
    spread = torch.rand(TASKS, ROWS, 2, dtype=torch.float64)
    apart, mixed = (x.expand(TASKS, ROWS, 2) for x in (centre + spread, spread))
    assert triplet_error(apart, *draw_others(apart, None), 1.0).eq(0).all()
    assert triplet_error(mixed, *draw_others(mixed, None), 1.0).gt(0).any()


def test_metric_term_needs_two_tasks() -> None:
    with pytest.raises(BMRLError, match="metric_weight needs at least two tasks"):
        make_distillation_loss(num_tasks=1, metric_weight=1.0)
    loss = make_distillation_loss(num_tasks=1)
    assert "loss_metric" not in loss(task_transitions(1, ROWS))


# -- gradients ---------------------------------------------------------------------------------


def test_isometry_error_compares_distances_within_a_task_alone() -> None:
    teachers = make_teachers(TASKS)
    loss = make_distillation_loss(
        teachers=teachers,
        isometry_weight=0.5,
        reward_scale=torch.arange(1.0, 5.0)[: batch().shape[0]],
        reduction="none",
    )
    data = batch()
    found = run(loss, data)["loss_isometry"]
    m = loss._encode(data).detach()
    for task, generator in enumerate(teachers[0]):
        asked = data[task].select("observation")
        asked["action_latent"] = torch.zeros(*asked.batch_size, LATENT_DIM, dtype=m.dtype)
        content = torch.cat(
            [data["next", "reward"][task] / (task + 1), generator(asked)["action"]], -1
        )
        errors = [
            [((a - b).norm() - (c - d).norm()) ** 2 for b, d in zip(m[task], content, strict=True)]
            for a, c in zip(m[task], content, strict=True)
        ]
        expected = 0.5 * torch.tensor(errors).mean(-1)
        torch.testing.assert_close(found[task], expected.to(found), atol=1e-5, rtol=1e-4)


def test_isometry_is_off_by_default_and_trains_the_encoder_alone() -> None:
    assert "loss_isometry" not in run(make_distillation_loss(), batch())
    loss = make_distillation_loss(isometry_weight=0.5)
    run(loss, batch())["loss_isometry"].backward()
    assert reached(loss) == {"task_encoder"}
    with pytest.raises(BMRLError, match="isometry_weight"):
        make_distillation_loss(isometry_weight=-1.0)


@pytest.mark.parametrize(
    "terms",
    [(), *((term,) for term in ENCODER_TERMS), ("generator", "qvalue"), ENCODER_TERMS],
    ids="-".join,
)
def test_the_chosen_terms_alone_train_the_encoder(terms: tuple[str, ...]) -> None:
    loss = make_distillation_loss(encoder_terms=terms, metric_weight=0.5)
    losses = run(make_distillation_loss(metric_weight=0.5), batch())
    assert (run(loss, batch()) == losses).all()
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
        value = run(loss, batch())[f"loss_{term}"]
        assert value.requires_grad == bool(networks | trained)
        if value.requires_grad:
            value.backward()
        assert reached(loss) == networks | trained, term


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
    total(loss(batch())).backward()
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
        results.append(loss(batch()))
        for module in (*generators, *critics):
            for parameter in module.parameters():
                parameter.data.add_(1.0)
    assert (results[0] == results[1]).all()


def test_the_networks_given_as_the_student_are_trained_in_place() -> None:
    networks = make_student_networks(TASKS, torch.float64)
    loss = MetaDistillationLoss(
        *networks, *make_teachers(TASKS), latent_dim=LATENT_DIM, context="current"
    )
    total(loss(batch())).backward()
    torch.optim.SGD(loss.parameters(), lr=1.0).step()
    own = {id(p): p for network in networks for p in network.parameters()}
    trained = {id(p): p for p in loss.parameters()}
    assert own.keys() == trained.keys()


# -- teachers of any kind ----------------------------------------------------------------------


def widened(module: TensorDictModule) -> TensorDictModule:
    """The same function by a wider network, whose further units are always zero."""
    module = deepcopy(module)
    network = module.module if isinstance(module.module, MLP) else module.module.network
    first, last = network[0], network[2]
    for layer, name in ((first, "weight"), (first, "bias")):
        value = getattr(layer, name).data
        setattr(layer, name, nn.Parameter(torch.cat([value, torch.zeros_like(value)])))
    more = torch.randn_like(last.weight.data)
    last.weight = nn.Parameter(torch.cat([last.weight.data, more], -1))
    return module


def test_teachers_of_different_widths_teach_as_equally_wide_ones() -> None:
    torch.manual_seed(1)
    generators, critics = make_teachers(TASKS)
    stacked = make_distillation_loss(teachers=(generators, critics))
    generators[1], critics[2] = widened(generators[1]), widened(critics[2])
    looped = make_distillation_loss(teachers=(generators, critics))
    assert stacked.teacher_generators.stacked
    assert stacked.teacher_qvalue_networks.stacked
    assert not looped.teacher_generators.stacked
    assert not looped.teacher_qvalue_networks.stacked
    results = [run(loss, batch()).detach().to_dict() for loss in (stacked, looped)]
    torch.testing.assert_close(*results, rtol=1e-10, atol=0)
    fresh = make_distillation_loss(teachers=(generators, critics), seed=1)
    fresh.load_state_dict(looped.state_dict(), strict=True)
    assert (run(fresh, batch()) == run(looped, batch())).all()


@pytest.mark.filterwarnings(NO_UPDATER)
def test_decoders_and_critics_of_plas_are_teachers() -> None:
    experts = [make_plas_loss(seed=seed) for seed in range(TASKS)]
    decoders = [PLASPolicy.frozen(expert).decoder for expert in experts]
    critics = []
    for expert in experts:
        critic, params = expert.critic(0)
        critics.append(deepcopy(critic))
        TensorDictParams(params.data.clone()).to_module(critics[-1], preserve_module_state=False)
    loss, data = make_distillation_loss(teachers=(decoders, critics)), batch()
    taught = loss.teach(data)
    for i, expert in enumerate(experts):
        observation, latent = data["observation"][i], taught["action_latent"][i]
        row = TensorDict({"observation": observation}, [ROWS])
        decoded = expert.decode(row, latent)
        torch.testing.assert_close(taught["action"][i], decoded["action"])
        value = expert.qvalue(decoded)[0]
        torch.testing.assert_close(taught["state_action_value"][i].squeeze(-1), value)
    total(loss(data)).backward()


def test_teachers_may_hold_dropout_that_no_other_network_holds() -> None:
    generators, critics = make_teachers(TASKS)
    value = ["state_action_value"]
    critics = [
        TensorDictSequential(critic, TensorDictModule(nn.Dropout(0.5), value, value))
        for critic in critics
    ]
    loss = make_distillation_loss(teachers=(generators, critics))
    loss(batch())


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
    networks = map(undeclared, make_student_networks(TASKS, torch.float64))
    _, classifier, generator, critic = networks
    encoder = TensorDictModule(
        lambda observation: observation, in_keys=["observation"], out_keys=["task_latent"]
    )
    return MetaDistillationLoss(
        encoder,
        classifier,
        generator,
        critic,
        *([undeclared(x) for x in teachers] for teachers in make_teachers(TASKS)),
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
        loss(batch())


# -- arguments ---------------------------------------------------------------------------------


def test_as_many_generators_as_critics_are_needed() -> None:
    generators, critics = make_teachers(TASKS)
    with pytest.raises(BMRLError, match="3 teacher_generators and 2 teacher_qvalue_networks"):
        MetaDistillationLoss(
            *make_student_networks(TASKS, torch.float64),
            generators,
            critics[:2],
            latent_dim=LATENT_DIM,
        )


def test_a_teacher_of_another_action_is_refused_and_not_broadcast() -> None:
    networks = [
        make_student_networks(TASKS, torch.float64),
        [make_decoder(3, 1, LATENT_DIM).double() for _ in range(TASKS)],
        [make_qvalue_network(3, 1).double() for _ in range(TASKS)],
    ]

    def build(students: Any, generators: Any, critics: Any) -> MetaDistillationLoss:
        options = {"latent_dim": LATENT_DIM, "context": "current"}
        return MetaDistillationLoss(*students, generators, critics, **options)

    with pytest.raises(BMRLError, match=r"'action' has the size 2 in .* and 1 in a teacher"):
        build(*networks)
    # Networks that do not say their sizes are found at the first batch.
    loss = build(*([undeclared(x) for x in part] for part in networks))
    with pytest.raises(BMRLError, match=r"'action' has the shape \(3, 5, 1\); valid: \(3, 5, 2\)"):
        loss(task_transitions(TASKS, ROWS))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda task: task.float(), r"'task' is torch.float32; valid: torch.int64"),
        (lambda task: task + 1, "'task' holds 3; valid: 0 to 2"),
    ],
)
def test_tasks_that_are_no_class_index_are_refused(change: Any, message: str) -> None:
    data = task_transitions(TASKS, ROWS)
    data["task"] = change(data["task"])
    with pytest.raises(BMRLError, match=message):
        make_distillation_loss()(data)


def test_scales_of_the_values_are_checked() -> None:
    with pytest.raises(BMRLError, match=r"qvalue_scale is .*above 0"):
        make_distillation_loss(qvalue_scale=torch.zeros(TASKS))
    with pytest.raises(BMRLError, match=r"qvalue_loc is .*each of the 3 tasks"):
        make_distillation_loss(qvalue_loc=torch.zeros(2))
