"""Inputs of the value estimators: where a return must stop."""

from __future__ import annotations

import pytest
import torch
from helpers import NO_UPDATER, make_bcq_loss, transitions
from tensordict import TensorDict
from torchrl.objectives.utils import ValueEstimators

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


def padded_episodes() -> TensorDict:
    """Episodes of three, four and five steps, padded to five."""
    data = transitions(3, 5)
    data["next", "done"] = data["next", "terminated"] = torch.zeros(3, 5, 1, dtype=torch.bool)
    data["collector", "mask"] = torch.arange(5) < torch.tensor([[3], [4], [5]])
    return data


@pytest.mark.parametrize("names", [["time", None], ["time", "episode"]])
def test_a_return_stops_at_padding_along_the_dimension_named_time(names: list[str | None]) -> None:
    data, value = padded_episodes(), torch.randn(3, 5, dtype=torch.float64)
    loss = make_bcq_loss(dtype=torch.float64)
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.9, lmbda=0.8)
    mask = data["collector", "mask"]
    expected = loss.td_target(data, value)
    turned = data.transpose(0, 1).contiguous()
    turned.names = names
    target = loss.td_target(turned, value.T.contiguous()).T
    torch.testing.assert_close(target[mask], expected[mask], rtol=1e-12, atol=0)
    for row, length in enumerate((3, 4, 5)):  # as the episode alone
        alone = loss.td_target(data[row : row + 1, :length].clone(), value[row : row + 1, :length])
        torch.testing.assert_close(expected[row, :length], alone[0], rtol=1e-12, atol=0)
