"""Networks that a loss has copied are recognised by their own parameters."""

from __future__ import annotations

import pytest
import torch
from helpers import NO_UPDATER
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import ActionVAE, BCQPolicy
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.ownership import is_copied

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


class Critic(nn.Module):
    """A critic with a given activation."""

    def __init__(self, activation: nn.Module) -> None:
        super().__init__()
        self.first, self.activation, self.last = nn.Linear(5, 8), activation, nn.Linear(8, 1)

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.last(self.activation(self.first(torch.cat([observation, action], -1))))


def make_critic(activation: nn.Module) -> TensorDictModule:
    keys = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}
    return TensorDictModule(Critic(activation), **keys)


def test_a_network_that_shares_only_an_activation_with_a_copied_one_may_act() -> None:
    activation = nn.ReLU()
    copied, other = make_critic(activation), make_critic(activation)
    BCQLoss(ActionVAE(3, 2), [copied, make_critic(activation)], bounds=(-1.0, 1.0))
    assert is_copied(copied)
    with pytest.raises(BMRLError, match="qvalue_network was copied into a BCQLoss"):
        BCQPolicy(ActionVAE(3, 2), copied)
    assert not is_copied(other)
    policy = BCQPolicy(ActionVAE(3, 2), other)
    assert policy(observation=torch.zeros(5, 3)).shape == (5, 2)
    layer = TensorDictModule(copied.module.first, in_keys=["x"], out_keys=["action"])
    with pytest.raises(BMRLError, match="generator was copied into a BCQLoss"):
        BCQPolicy(layer, other)
