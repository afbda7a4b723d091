"""Trainings that go wrong are found and named; those that go well are left alone."""

from __future__ import annotations

import pytest
import torch

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.training.health import (
    check_metrics,
    check_proposals,
    largest_metric,
    value_limits,
)

WHERE = "bcq lift, update 100"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_metric_that_is_not_finite_is_named(value: float) -> None:
    with pytest.raises(BMRLError, match=rf"{WHERE}: loss_qvalue is {value}; the last checkpoint"):
        check_metrics({"loss_generator": 0.5, "loss_qvalue": torch.tensor(value)}, WHERE)


def test_values_beyond_what_can_be_earned_are_named_and_others_left_alone() -> None:
    limits = value_limits(torch.tensor([0.5, -3.0]), gamma=0.99)
    largest = 3.0 / (1 - 0.99)  # of any return
    for value in (largest, -largest, 4.9 * largest):
        check_metrics({"pred_value": value, "next_state_value": value}, WHERE, limits)
    for value in (5.1 * largest, -5.1 * largest):
        with pytest.raises(
            BMRLError, match=r"next_state_value is -?1530, above 1500; the training has diverged"
        ):
            check_metrics({"pred_value": 0.0, "next_state_value": value}, WHERE, limits)


def test_a_batch_without_a_reward_bounds_no_tighter_than_one_a_step() -> None:
    assert value_limits(torch.zeros(8, 1), gamma=0.9)["pred_value"] == pytest.approx(50.0)


def test_without_discount_nothing_bounds_values_but_all_metrics_have_a_limit() -> None:
    limits = value_limits(torch.ones(8), gamma=1.0)
    check_metrics({"pred_value": 1e12}, WHERE, limits)
    with pytest.raises(BMRLError, match="loss_qvalue is 1e\\+09, above 1e\\+08"):
        check_metrics({"loss_qvalue": 1e9}, WHERE, limits)


def test_the_limit_of_losses_grows_with_the_square_of_the_rewards() -> None:
    largest = largest_metric(torch.zeros(2), torch.tensor([[-1e4], [3.0]]))
    check_metrics({"loss_qvalue": 2e8}, WHERE, largest=largest)
    with pytest.raises(BMRLError, match="loss_qvalue is 2e\\+16, above 1e\\+16"):
        check_metrics({"loss_qvalue": 2e16}, WHERE, largest=largest)
    assert largest_metric(torch.tensor([0.1])) == largest_metric() == 1e8


def test_proposals_that_do_not_differ_are_named() -> None:
    torch.manual_seed(0)
    one = torch.rand(8, 1, 7).expand(8, 10, 7)
    with pytest.raises(BMRLError, match=f"{WHERE}: all candidates of a state are equal"):
        check_proposals(one, torch.rand(8, 7), WHERE)
    check_proposals(one + 1e-3 * torch.rand(8, 10, 7), torch.rand(8, 7), WHERE)
    # States may agree; and where there is one candidate, none can differ.
    check_proposals(torch.rand(1, 10, 7).expand(8, 10, 7), torch.rand(8, 7), WHERE)
    check_proposals(one[:, :1], torch.rand(8, 7), WHERE)


def test_proposals_at_the_bounds_are_named_unless_the_demonstrations_lie_there() -> None:
    torch.manual_seed(0)
    bounds = torch.randint(0, 2, (8, 10, 7)) * 2.0 - 1.0
    demonstrated = torch.rand(8, 7) - 0.5
    demonstrated[:, 6] = 1.0  # a gripper's action
    with pytest.raises(BMRLError, match=r"100% of .* lie at a bound, and 14%"):
        check_proposals(bounds, demonstrated, WHERE)
    check_proposals(bounds, bounds[:, 0], WHERE)
    mixed = bounds.clone()
    mixed[..., 0] = 0.3
    check_proposals(mixed, demonstrated, WHERE)
