"""Networks that a loss copies or shares are trained as the user expects, or refused."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from helpers import (
    CRITIC_KEYS,
    DIMS,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    discrete_transitions,
    make_bcq_loss,
    make_critics,
    make_student_networks,
    make_teachers,
    refused,
    total,
    transitions,
)
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from torchrl_bmrl.modules import ActionVAE, BCQPolicy, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, MetaDistillationLoss, StackedLoss
from torchrl_bmrl.training import gradient_step, make_adam

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


# -- what is trained -------------------------------------------------------------------------------


def test_a_policy_of_a_critic_that_a_loss_has_copied_is_refused() -> None:
    generator, critics = ActionVAE(*DIMS), [make_qvalue_network(*DIMS) for _ in range(2)]
    BCQPolicy(generator, critics[0])  # no loss has copied it yet
    BCQLoss(generator, critics, bounds=(-1.0, 1.0))
    with refused(
        r"qvalue_network was copied into a BCQLoss.*valid: .*live\(loss\).*frozen\(loss\)"
    ):
        BCQPolicy(generator, critics[0])
    alone = make_qvalue_network(*DIMS)
    BCQLoss(ActionVAE(*DIMS), alone, num_qvalue_nets=1, bounds=(-1.0, 1.0))
    BCQPolicy(generator, alone)  # the loss trains this one itself


def test_networks_whose_copies_a_loss_trains_are_refused_however_they_are_wrapped() -> None:
    vae, critics = ActionVAE(*DIMS).double(), make_critics(2)
    BCQLoss(vae, critics, bounds=(-1.0, 1.0))
    for again in (
        TensorDictSequential(critics[0]),
        TensorDictModule(critics[0].module, **CRITIC_KEYS),
    ):
        with refused("copied into a BCQLoss"):
            BCQPolicy(vae, again)
    students, (generators, _) = make_student_networks(2, torch.float64), make_teachers(2)
    with refused("a teacher's critic was copied into a BCQLoss"):
        MetaDistillationLoss(*students, generators, critics, latent_dim=LATENT_DIM)
    other = ActionVAE(*DIMS).double()
    StackedLoss([BCQLoss(other, make_critics(1)[0], num_qvalue_nets=1, bounds=(-1.0, 1.0))])
    with refused("generator was copied into a StackedLoss"):
        BCQPolicy(other, make_critics(1)[0])


def test_an_optimizer_of_parameters_that_the_loss_does_not_read_is_refused() -> None:
    critics = make_critics(2)
    loss = BCQLoss(ActionVAE(*DIMS).double(), critics, bounds=(-1.0, 1.0))
    optimizer = make_adam([p for critic in critics for p in critic.parameters()], lr=1e-2)
    with refused("does not depend on the optimizer's parameters; valid: parameters of the loss"):
        gradient_step(optimizer, loss.qvalue_loss(transitions(8))[0])
    with refused("no parameters"):
        make_adam([], lr=1e-2)


def test_a_parameter_that_a_loss_does_not_reach_stays_as_with_torch_s_adam() -> None:
    results = []
    for ours in (True, False):
        one, two = nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(1))
        optimizer = make_adam([one, two], lr=0.1) if ours else torch.optim.Adam([one, two], lr=0.1)
        for used in (one, two, one, two):
            if ours:
                gradient_step(optimizer, used.square().sum())
                continue
            optimizer.zero_grad()
            used.square().sum().backward()
            optimizer.step()
        results.append(torch.cat([one, two]).detach())
    torch.testing.assert_close(*results)


# -- copies ----------------------------------------------------------------------------------------


def on_a_torso() -> DiscreteBCQLoss:
    torch.manual_seed(0)
    torso = nn.Linear(OBSERVATION_DIM, 8)

    def network(key: str) -> TensorDictModule:
        layers = nn.Sequential(torso, nn.ReLU(), nn.Linear(8, 3)).double()
        return TensorDictModule(layers, ["observation"], [key])

    critics = [network("action_value") for _ in range(2)]
    return DiscreteBCQLoss(network("logits"), critics, separate_losses=True)


@pytest.mark.parametrize("replaced", [False, True])
def test_a_copied_loss_trains_a_shared_torso_as_the_original_does(replaced: bool) -> None:
    original = on_a_torso()
    copy = deepcopy(original)
    if replaced:  # the critics then have a torso of their own
        copy.generator_params = deepcopy(copy.generator_params)
    weights = []
    for loss in (original, copy):
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for _ in range(5):
            optimizer.zero_grad()
            total(loss(discrete_transitions(8))).backward()
            optimizer.step()
        weights.append(loss.qvalue_network_params["critics", "0", "module", "0", "weight"])
    fresh = on_a_torso().qvalue_network_params["critics", "0", "module", "0", "weight"]
    assert not torch.equal(weights[1], fresh)
    if not replaced:
        assert len(list(copy.parameters())) == len(list(original.parameters()))
        assert torch.equal(*weights)


class Tied(nn.Module):
    """A critic with two layers that share their weight."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(5, 5)
        self.second = nn.Linear(5, 5)
        self.second.weight = self.first.weight
        self.head = nn.Linear(5, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        x = torch.cat([observation, action], -1)
        return self.head(self.second(self.first(x).relu()).relu())


def test_layers_of_a_critic_that_are_one_stay_one() -> None:
    critics = [TensorDictModule(Tied().double(), **CRITIC_KEYS) for _ in range(2)]
    loss = BCQLoss(ActionVAE(*DIMS).double(), critics, bounds=(-1.0, 1.0))
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    total(loss(transitions(8))).backward()
    optimizer.step()
    params = loss.critic(1)[1]
    assert torch.equal(params["module", "first", "weight"], params["module", "second", "weight"])
    assert not torch.equal(params["module", "first", "weight"], make_critics(1)[0].module[0].weight)


class Scaled(nn.Module):
    """A critic with an attribute that is not a parameter."""

    def __init__(self, scale: Any) -> None:
        super().__init__()
        self._scale, self.head = scale, nn.Linear(5, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        scale = self._scale.mean() if isinstance(self._scale, Tensor) else self._scale
        return scale * self.head(torch.cat([observation, action], -1))


@pytest.mark.parametrize("scales", [(1.0, 80.0), (torch.ones(2000), 80 * torch.ones(2000))])
def test_critics_that_differ_in_a_choice_compute_what_each_of_them_does(scales: Any) -> None:
    critics = [TensorDictModule(Scaled(scale).double(), **CRITIC_KEYS) for scale in scales]
    data = transitions(8)
    expected = torch.stack([critic(data.clone())["state_action_value"] for critic in critics])
    loss = BCQLoss(ActionVAE(*DIMS).double(), critics, bounds=(-1.0, 1.0))
    torch.testing.assert_close(loss.qvalue(data), expected.squeeze(-1))


def test_a_frozen_layer_of_a_single_critic_is_the_same_in_its_copies() -> None:
    critic = make_critics(1)[0]
    critic.module[0].requires_grad_(False)
    loss = BCQLoss(ActionVAE(*DIMS).double(), critic, bounds=(-1.0, 1.0))
    first, second = (loss.critic(index)[1]["module", "0", "weight"] for index in range(2))
    assert torch.equal(first, second)


def test_reset_critics_differ_and_have_the_scale_of_fresh_ones() -> None:
    loss = make_bcq_loss()
    fresh = make_critics(1, torch.float64)[0].module[0].weight.std().item()
    loss.reset_parameters_recursive()
    weight = loss.qvalue_network_params["module", "0", "weight"]
    assert not torch.equal(weight[0], weight[1])
    assert 0.7 < weight.std().item() / fresh < 1.4
    target = loss.target_qvalue_network_params["module", "0", "weight"]
    assert torch.equal(weight, target)
