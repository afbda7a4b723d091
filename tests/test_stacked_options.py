"""An option, a key or a call of a stack reaches each of its members."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import (
    NO_UPDATER,
    as_keywords,
    discrete_transitions,
    make_bcq_loss,
    make_discrete_bcq_loss,
    make_discrete_network,
    refused,
    run,
    stack_of_bcq,
    state,
    total,
)
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP

from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.objectives import DiscreteBCQLoss, StackedLoss
from torchrl_bmrl.testing.measures import gradients

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


@pytest.mark.parametrize(
    ("name", "value"),
    [("gamma", 0.0), ("loss_function", "l1"), ("reduction", "sum"), ("value_bounds", (0.0, 0.1))],
)
def test_an_option_that_is_assigned_to_a_stack_reaches_its_members(name: str, value: Any) -> None:
    stack, data = stack_of_bcq()
    before = run(stack, data)["loss_qvalue"]
    setattr(stack, name, value)
    assert getattr(stack, name) == value
    assert getattr(stack.member(1), name) == value
    assert not torch.equal(run(stack, data)["loss_qvalue"], before)


def test_numbers_of_another_length_than_the_stack_are_refused() -> None:
    stack, _ = stack_of_bcq()
    stack.lmbda = torch.tensor([0.25, 0.75])
    assert [float(stack.member(i).lmbda) for i in range(2)] == [0.25, 0.75]
    with refused("lmbda has 3 numbers; valid: 2, or one"):
        stack.lmbda = torch.zeros(3)


def test_keys_masks_estimators_and_coefficients_of_a_stack_are_its_members() -> None:
    losses, data = stack_of_bcq()
    losses.make_value_estimator(gamma=0.5)
    losses.kl_weight = 2.0
    losses.loss_mask_key = "valid"
    losses.set_keys(reward="points")
    data["next", "points"] = data["next"].pop("reward")
    data["valid"] = torch.arange(8).expand(2, 8) < 6
    assert losses.kl_weight.tolist() == [2.0, 2.0]
    assert (losses.gamma, losses.loss_mask_key) == (0.5, "valid")
    _, metrics = losses.qvalue_loss(data)
    for index in range(2):
        alone = make_bcq_loss(seed=index, gamma=0.5, kl_weight=2.0)
        alone.loss_mask_key = "valid"
        alone.set_keys(reward="points")
        own = alone.qvalue_loss(data[index])[1]
        torch.testing.assert_close(metrics["pred_value"][index], own["pred_value"])
        member = losses.member(index)
        assert (member.gamma, member.kl_weight.item(), member.loss_mask_key) == (0.5, 2.0, "valid")


def test_a_stack_is_called_with_keywords_and_selects_its_outputs() -> None:
    losses, data = stack_of_bcq()
    torch.manual_seed(0)
    results = losses(**as_keywords(data, losses.in_keys))
    expected = run(losses, data)
    assert losses.out_keys == list(expected.keys())
    for key, value in zip(losses.out_keys, results, strict=True):
        assert torch.equal(value, expected[key]), key
    losses.select_out_keys("loss_qvalue")
    assert list(losses(data).keys()) == ["loss_qvalue"]


def test_the_summed_losses_of_a_stack_give_every_member_its_own_gradient() -> None:
    # Discrete BCQ draws no noise, so that the gradients are comparable.
    losses = StackedLoss([make_discrete_bcq_loss(seed=seed) for seed in range(2)])
    data = torch.stack([discrete_transitions(8, seed=seed) for seed in range(2)])
    total(losses(data)).backward()
    for index in range(2):
        alone = make_discrete_bcq_loss(seed=index)
        total(alone(data[index])).backward()
        own, stacked = gradients(alone), gradients(losses)
        assert own.keys() == stacked.keys()
        assert all(gradient.any() for gradient in own.values())
        for name, gradient in own.items():
            torch.testing.assert_close(stacked[name][index], gradient)


def test_parameters_of_a_stack_are_initialised_anew() -> None:
    losses, _ = stack_of_bcq()
    before = state(losses)
    losses.reset_parameters_recursive()
    after = losses.state_dict()
    weights = [key for key in before if key.endswith("weight") and "." in key]
    assert weights
    for key in weights:
        assert not torch.equal(after[key], before[key]), key
        assert not torch.equal(after[key][0], after[key][1]), key
    for name in ("weight", "bias"):
        path = ("module", "0", name)
        assert torch.equal(
            losses.qvalue_network_params[path], losses.target_qvalue_network_params[path]
        )


def test_a_member_has_the_type_of_its_stack() -> None:
    stack, _ = stack_of_bcq()
    assert next(stack.float().member(1).parameters()).dtype == torch.float32


def test_a_live_policy_of_a_stack_s_member_is_refused() -> None:
    stack, _ = stack_of_bcq()
    with refused("member of a stack, which trains a copy of it; valid: .*frozen"):
        BCQPolicy.live(stack.member(0))
    BCQPolicy.frozen(stack.member(0))


def test_a_stack_of_lazy_losses_is_refused() -> None:
    def build() -> DiscreteBCQLoss:
        critic = TensorDictModule(MLP(out_features=3), ["observation"], ["action_value"])
        return DiscreteBCQLoss(make_discrete_network("logits", torch.float32), critic)

    with refused("parameters without a shape; valid: losses that have run once"):
        StackedLoss([build(), build()])
