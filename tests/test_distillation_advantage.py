"""The advantage term of the distillation: differences in value between actions of a state."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from helpers import (
    DIMS,
    LATENT_DIM,
    TASKS,
    make_distillation_loss,
    make_teachers,
    reached,
    run,
    task_transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import make_task_classifier, make_task_encoder
from torchrl_bmrl.objectives import MetaDistillationLoss

SCALE = torch.arange(1.0, TASKS + 1)


def term(loss: Any, data: TensorDict) -> Tensor:
    """The term, with the random numbers that start at seed 0."""
    torch.manual_seed(0)
    return loss(data)["loss_advantage"]


def test_it_compares_the_student_s_difference_of_two_latents_with_the_teacher_s() -> None:
    loss = make_distillation_loss(
        advantage_weight=0.5,
        advantage_scale=SCALE,
        qvalue_scale=SCALE + 1,
        context="current",
        reduction="none",
    )
    data = task_transitions()
    found = term(loss, data)
    torch.manual_seed(0)
    m = loss.embed(data)  # with the current transition it draws no random numbers
    values = []
    for _ in range(2):
        taught = loss.teach(data)
        state = taught.select("observation", "action_latent").set("task_latent", m)
        action = loss.get_stateful_net("student_generator")(state)["action"]
        state["action"] = action
        value = loss.get_stateful_net("student_qvalue_network")(state)["state_action_value"]
        values.append((value, taught["state_action_value"]))
    (first, target), (second, other) = values
    error = ((first - second) - (target - other)).squeeze(-1) / SCALE[:, None]
    torch.testing.assert_close(found, 0.5 * error.square())
    assert (error.abs() > 1e-4).all()  # the latents differ


def test_it_is_off_by_default_and_a_negative_weight_is_refused() -> None:
    assert "loss_advantage" not in run(make_distillation_loss(), task_transitions())
    assert "loss_advantage" not in make_distillation_loss().out_keys
    assert "loss_advantage" in make_distillation_loss(advantage_weight=1.0).out_keys
    with pytest.raises(BMRLError, match="advantage_weight"):
        make_distillation_loss(advantage_weight=-1.0)
    with pytest.raises(BMRLError, match=r"advantage_scale is .*; valid: .*above 0"):
        make_distillation_loss(advantage_scale=torch.zeros(TASKS))


@pytest.mark.parametrize("terms", [("qvalue",), ("generator",)])
def test_it_trains_the_critic_and_the_encoder_only_where_values_do(terms: tuple[str, ...]) -> None:
    loss = make_distillation_loss(advantage_weight=1.0, encoder_terms=terms)
    run(loss, task_transitions())["loss_advantage"].backward()
    encoder = {"task_encoder"} if terms == ("qvalue",) else set()
    assert reached(loss) == {"student_qvalue_network"} | encoder


class _Shifted(nn.Module):
    """A value that depends on the action alone, up to a function of the state."""

    def __init__(self, shift: float) -> None:
        super().__init__()
        self.shift, self.unused = shift, nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, observation: Tensor, action: Tensor, *_: Tensor) -> Tensor:
        state = self.shift * observation.sum(-1, keepdim=True)
        return action.sum(-1, keepdim=True) + state + 0 * self.unused


def test_an_error_that_depends_on_the_state_alone_costs_nothing() -> None:
    """A policy chooses among the actions of one state."""
    keys = ["observation", "action"]
    decoder = make_teachers(1)[0][0].module
    teachers = [
        TensorDictModule(deepcopy(decoder), ["observation", "action_latent"], ["action"])
        for _ in range(TASKS)
    ]
    critics = [TensorDictModule(_Shifted(0.0), keys, ["state_action_value"]) for _ in range(TASKS)]
    latents = ["observation", "action_latent", "task_latent"]
    loss = MetaDistillationLoss(
        make_task_encoder(*DIMS, 2).double(),
        make_task_classifier(TASKS).double(),
        TensorDictModule(_Same(deepcopy(decoder)), latents, ["action"]),
        TensorDictModule(_Shifted(3.0), [*keys, "task_latent"], ["state_action_value"]),
        teachers,
        critics,
        latent_dim=LATENT_DIM,
        advantage_weight=1.0,
    )
    losses = run(loss, task_transitions())
    assert losses["loss_advantage"].item() == pytest.approx(0.0, abs=1e-12)
    assert losses["loss_qvalue"] > 1


class _Same(nn.Module):
    """The teacher's decoder, which ignores m."""

    def __init__(self, decoder: nn.Module) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, observation: Tensor, latent: Tensor, task_latent: Tensor) -> Tensor:
        return self.decoder(observation, latent)
