"""The task embedding comes from the chosen context, and terms of distances shape it."""

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
    undeclared,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import triplet_error
from torchrl_bmrl.objectives import MetaDistillationLoss
from torchrl_bmrl.objectives.task_rows import draw_others

# -- where m comes from ----------------------------------------------------------------------------


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
    """A loss whose encoder returns the observation, so that an embedding shows its rows."""
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
    counts = (size * latent).view(TASKS, rows, TASKS, rows)  # task, row; task, row of its context
    assert torch.equal(counts, counts.round())
    assert counts.min() == 0
    for i in range(TASKS):
        assert torch.equal(counts[i, :, i].sum(-1), torch.full((rows,), float(size)).double())
        made_of = counts[i, :, i]
        assert made_of.diagonal().mean() < 0.3 * size  # seldom its own row
        assert (made_of.sum(0) > 0).double().mean() > 0.5  # spread over the task's rows


def test_current_context_is_the_paper_s_and_needs_no_previous_transition() -> None:
    loss = make_distillation_loss(context="current")
    data = task_transitions().exclude("previous")
    assert torch.equal(loss.embed(data), encode(loss, data))
    assert not any("previous" in key for key in loss.in_keys)
    loss(data)


def test_data_without_the_previous_transition_are_refused_by_name() -> None:
    loss = make_distillation_loss(context="previous")
    data = task_transitions().exclude("previous")
    with pytest.raises(BMRLError, match=r"no 'previous'.*valid: .*with_previous"):
        loss(data)
    loss.set_keys(previous="before")
    with pytest.raises(BMRLError, match="no 'before'"):
        loss(task_transitions())


# -- the metric term -------------------------------------------------------------------------------


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
    with pytest.raises(BMRLError, match=r"metric_weight, .* need at least two tasks"):
        make_distillation_loss(num_tasks=1, metric_weight=1.0)
    loss = make_distillation_loss(num_tasks=1)
    assert "loss_metric" not in loss(task_transitions(1, ROWS))


# -- the isometry term -----------------------------------------------------------------------------


def test_isometry_error_compares_distances_within_a_task_alone() -> None:
    teachers = make_teachers(TASKS)
    loss = make_distillation_loss(
        teachers=teachers,
        isometry_weight=0.5,
        reward_scale=torch.arange(1.0, TASKS + 1),
        reduction="none",
    )
    data = task_transitions()
    found = run(loss, data)["loss_isometry"]
    m = encode(loss, data).detach()
    for task, generator in enumerate(teachers[0]):
        asked = data[task].select("observation")
        asked["action_latent"] = torch.zeros(*asked.batch_size, LATENT_DIM, dtype=m.dtype)
        content = torch.cat(
            [data["next", "reward"][task] / (task + 1), generator(asked)["action"].detach()], -1
        )
        errors = [
            [((a - b).norm() - (c - d).norm()) ** 2 for b, d in zip(m[task], content, strict=True)]
            for a, c in zip(m[task], content, strict=True)
        ]
        expected = 0.5 * torch.tensor(errors).mean(-1)
        torch.testing.assert_close(found[task], expected.to(found), atol=1e-5, rtol=1e-4)


def test_isometry_is_off_by_default_and_trains_the_encoder_alone() -> None:
    assert "loss_isometry" not in run(make_distillation_loss(), task_transitions())
    loss = make_distillation_loss(isometry_weight=0.5)
    run(loss, task_transitions())["loss_isometry"].backward()
    assert reached(loss) == {"task_encoder"}
    with pytest.raises(BMRLError, match="isometry_weight"):
        make_distillation_loss(isometry_weight=-1.0)
