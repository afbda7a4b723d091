"""The base of all losses: reduction where priority weights and masks meet."""

from __future__ import annotations

import pytest
import torch
from helpers import NO_UPDATER, make_bcq_loss, transitions

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_a_weighted_batch_without_a_valid_row_has_the_loss_zero_and_no_gradient(
    reduction: str,
) -> None:
    loss, data = make_bcq_loss(dtype=torch.float64, reduction=reduction), transitions(8)
    data["priority_weight"] = torch.linspace(0.1, 1.0, 8, dtype=torch.float64)
    data["collector", "mask"] = torch.zeros(8, dtype=torch.bool)
    data["next", "reward"].fill_(torch.nan)
    losses = loss(data)
    total = sum(value.sum() for key, value in losses.items() if key.startswith("loss_"))
    assert total == 0
    total.backward()
    gradients = [p.grad for p in loss.parameters() if p.grad is not None]
    assert gradients
    assert not any(gradient.any() for gradient in gradients)


def test_a_weighted_mean_is_that_of_the_valid_rows_alone() -> None:
    loss = make_bcq_loss(dtype=torch.float64)
    weights = torch.linspace(0.1, 1.0, 8, dtype=torch.float64)
    mask = torch.arange(8) % 3 > 0
    data = transitions(8)
    data["priority_weight"], data["collector", "mask"] = weights, mask
    value = torch.arange(8.0, dtype=torch.float64)
    expected = (value * weights)[mask].sum() / weights[mask].sum()
    torch.testing.assert_close(loss.reduce(value, data), expected)
