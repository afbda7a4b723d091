"""Lazy networks get their parameters from known sizes, and nothing else changes in them."""

from __future__ import annotations

import pytest
import torch
from helpers import NO_UPDATER
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.modules import ActionVAE
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.objectives.sizes import is_lazy, warm_up

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


class LazyCritic(nn.Module):
    """A critic whose first layer has no shape yet, with statistics that a run would change."""

    def __init__(self) -> None:
        super().__init__()
        layers = nn.LazyLinear(8), nn.BatchNorm1d(8), nn.Dropout(), nn.Linear(8, 1)
        self.network = nn.Sequential(*layers)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.network(torch.cat([observation, action], -1))


def lazy_critic() -> TensorDictModule:
    keys = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}
    return TensorDictModule(LazyCritic(), **keys)


@pytest.mark.parametrize("training", [True, False])
def test_warming_up_changes_no_statistics_and_no_mode(training: bool) -> None:
    critic = lazy_critic().train(training)
    warm_up("critic", critic, {"observation": 3, "action": 2})
    assert not is_lazy(critic)
    norm = critic.module.network[1]
    assert norm.num_batches_tracked == 0
    assert (norm.running_mean == 0).all()
    assert (norm.running_var == 1).all()
    assert all(part.training == training for part in critic.modules())


def test_the_critics_of_a_loss_have_seen_no_batch_when_it_is_made() -> None:
    loss = BCQLoss(ActionVAE(3, 2), [lazy_critic() for _ in range(2)], bounds=(-1.0, 1.0))
    counts = [x for key, x in loss.state_dict().items() if key.endswith("num_batches_tracked")]
    assert sum(count.numel() for count in counts) == 4  # of two critics and two targets
    assert not any(count.any() for count in counts)
