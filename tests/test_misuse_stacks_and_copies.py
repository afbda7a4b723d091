"""Copies, stacks and optimizers: what a user holds is what is trained, or an error says so."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from helpers import (
    ACTION_DIM,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    discrete_transitions,
    make_bcq_loss,
    make_critics,
    make_distillation_loss,
    make_student_networks,
    make_teachers,
    run,
    task_transitions,
    total,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, MultiOneHot, OneHot
from torchrl.objectives import ValueEstimators

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import ActionVAE, BCQPolicy, DiscreteBCQPolicy, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, MetaDistillationLoss, StackedLoss
from torchrl_bmrl.training import gradient_step, make_adam

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
DIMS = (OBSERVATION_DIM, ACTION_DIM)
CRITIC = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}


def refused(message: str) -> Any:
    return pytest.raises(BMRLError, match=message)


def stack_of(number: int = 2) -> tuple[StackedLoss, TensorDict]:
    losses = [make_bcq_loss(seed=seed) for seed in range(number)]
    return StackedLoss(losses), torch.stack([transitions(8, seed=seed) for seed in range(number)])


# -- stacks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [("gamma", 0.0), ("loss_function", "l1"), ("reduction", "sum"), ("value_bounds", (0.0, 0.1))],
)
def test_an_option_that_is_assigned_to_a_stack_reaches_its_members(name: str, value: Any) -> None:
    stack, data = stack_of()
    before = run(stack, data)["loss_qvalue"]
    setattr(stack, name, value)
    assert getattr(stack, name) == value
    assert getattr(stack.member(1), name) == value
    assert not torch.equal(run(stack, data)["loss_qvalue"], before)


def test_numbers_of_another_length_than_the_stack_are_refused() -> None:
    stack, _ = stack_of()
    stack.lmbda = torch.tensor([0.25, 0.75])
    assert [float(stack.member(i).lmbda) for i in range(2)] == [0.25, 0.75]
    with refused("lmbda has 3 numbers; valid: 2, or one"):
        stack.lmbda = torch.zeros(3)


def test_a_live_policy_of_a_stack_s_member_is_refused() -> None:
    stack, _ = stack_of()
    with refused("member of a stack, which trains a copy of it; valid: .*frozen"):
        BCQPolicy.live(stack.member(0))
    BCQPolicy.frozen(stack.member(0))


def test_a_member_has_the_type_of_its_stack() -> None:
    stack, _ = stack_of()
    assert next(stack.float().member(1).parameters()).dtype == torch.float32


# -- what is trained -------------------------------------------------------------------------------


def test_networks_whose_copies_a_loss_trains_are_refused_however_they_are_wrapped() -> None:
    vae, critics = ActionVAE(*DIMS).double(), make_critics(2)
    BCQLoss(vae, critics, bounds=(-1.0, 1.0))
    for again in (
        TensorDictSequential(critics[0]),
        TensorDictModule(critics[0].module, **CRITIC),
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
    if replaced:  # by parameters that the critics do not share: they have a torso of their own
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
    """A critic two of whose layers are one."""

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
    critics = [TensorDictModule(Tied().double(), **CRITIC) for _ in range(2)]
    loss = BCQLoss(ActionVAE(*DIMS).double(), critics, bounds=(-1.0, 1.0))
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    total(loss(transitions(8))).backward()
    optimizer.step()
    params = loss.critic(1)[1]
    assert torch.equal(params["module", "first", "weight"], params["module", "second", "weight"])
    assert not torch.equal(params["module", "first", "weight"], make_critics(1)[0].module[0].weight)


class Scaled(nn.Module):
    """A critic with a choice that is no parameter."""

    def __init__(self, scale: Any) -> None:
        super().__init__()
        self._scale, self.head = scale, nn.Linear(5, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        scale = self._scale.mean() if isinstance(self._scale, Tensor) else self._scale
        return scale * self.head(torch.cat([observation, action], -1))


@pytest.mark.parametrize("scales", [(1.0, 80.0), (torch.ones(2000), 80 * torch.ones(2000))])
def test_critics_that_differ_in_a_choice_compute_what_each_of_them_does(scales: Any) -> None:
    critics = [TensorDictModule(Scaled(scale).double(), **CRITIC) for scale in scales]
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


def test_the_discount_of_a_loaded_state_is_the_loss_s() -> None:
    loss = make_bcq_loss()
    loss.load_state_dict(make_bcq_loss(gamma=0.5).state_dict())
    assert loss.gamma == 0.5
    loss.make_value_estimator()
    assert loss.value_estimator.gamma.item() == 0.5


@pytest.mark.parametrize("value", [torch.tensor(5.0), torch.tensor(-1), torch.tensor(torch.nan)])
def test_a_coefficient_that_is_assigned_as_a_tensor_is_checked_too(value: Tensor) -> None:
    loss = make_bcq_loss()
    with refused("lmbda is tensor.*; valid: between 0 and 1"):
        loss.lmbda = value
    loss.lmbda = torch.tensor(1)
    loss.lmbda = 0.5
    assert loss.lmbda.item() == 0.5


# -- bounds, specs, data ---------------------------------------------------------------------------


def test_bounds_are_compared_whole_and_are_finite() -> None:
    generator = ActionVAE(*DIMS, bounds=(-1.5, 1.5))
    with refused("valid: equal ones"):
        whole = (torch.tensor(-1), torch.tensor(1))
        BCQLoss(generator, make_qvalue_network(*DIMS), bounds=whole)
    with refused("bound of the action is .*-1.0.*, and the generator's .*-1.5"):
        BCQPolicy(generator, make_qvalue_network(*DIMS), bounds=(-1, 1))
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, torch.inf]), shape=(2,))
    with refused("bounds of the action are .*inf.*; valid: finite numbers"):
        make_bcq_loss(bounds=None, action_spec=spec)


def test_specs_of_several_actions_at_once_are_refused_and_nested_ones_found() -> None:
    def build(spec: Any) -> DiscreteBCQLoss:
        networks = [
            TensorDictModule(nn.Linear(3, 3), ["observation"], [key])
            for key in ("logits", "action_value")
        ]
        return DiscreteBCQLoss(*networks, action_space=spec)

    for spec in (MultiOneHot([2, 2]), Binary(3)):
        with refused("valid .*: one-hot, categorical"):
            build(spec)
    assert build(Composite(agent=Composite(move=OneHot(3)))).num_actions == 3
    with refused(r"the spec has .*, not 'action'; valid: the spec of the action alone"):
        build(Composite(one=OneHot(3), two=OneHot(3)))


def test_rows_of_another_task_than_their_number_are_refused() -> None:
    data = task_transitions(3, 5)
    data["task"] = data["task"].flip(0)
    with refused("'task' holds 2 in row 0; valid: 0 there"):
        make_distillation_loss()(data)


def test_weights_that_are_not_finite_are_refused_and_no_weight_at_all_is_no_nan() -> None:
    loss, data = make_bcq_loss(), transitions(8)
    data["priority_weight"] = torch.ones(8).double()
    data["priority_weight"][3] = torch.nan
    with refused("'priority_weight' holds 1 numbers that are not finite"):
        loss(data)
    data["collector", "mask"] = torch.zeros(8, 1, dtype=torch.bool)
    assert loss(data)["loss_qvalue"] == 0
    data["collector", "mask"] = data["collector", "mask"].double()
    with refused("mask .* is torch.float64; valid: torch.bool"):
        loss(data)


def test_time_may_be_the_first_dimension_of_padded_data() -> None:
    loss = make_bcq_loss()
    loss.make_value_estimator(ValueEstimators.TDLambda)
    data = transitions(4, 6)
    data["next", "done"].zero_()
    data["next", "terminated"].zero_()
    data["collector", "mask"] = (torch.arange(6) < 4).expand(4, 6).unsqueeze(-1).clone()
    value = torch.randn(4, 6).double()
    expected = loss.td_target(data, value)
    first = data.transpose(0, 1).contiguous()
    first.names = ["time", None]
    result = loss.td_target(first, value.T.contiguous()).T
    torch.testing.assert_close(result[:, :4], expected[:, :4])


# -- keywords --------------------------------------------------------------------------------------


def test_keywords_of_pictures_and_of_numbers_without_features_have_their_rows() -> None:
    class Picture(nn.Module):
        def __init__(self, size: int) -> None:
            super().__init__()
            self.head = nn.Linear(48, size)

        def forward(self, pixels: Tensor, *others: Tensor) -> Tensor:
            return self.head(pixels.flatten(-3))

    networks = [
        TensorDictModule(Picture(3), ["pixels"], [key]) for key in ("logits", "action_value")
    ]
    policy = DiscreteBCQPolicy(*networks)
    assert policy(pixels=torch.rand(5, 3, 4, 4)).shape == (5, 3)
    table = [
        TensorDictModule(nn.Embedding(4, 3), ["state"], [key]) for key in ("logits", "action_value")
    ]
    acted = DiscreteBCQPolicy(*table)(
        TensorDict({"state": torch.arange(4), "x": torch.ones(4)}, [4])
    )
    assert acted["action"].shape == (4, 3)
    assert "x" in acted
    with pytest.raises(TypeError, match=r"got .*'other'.*; valid: .*'state'"):
        DiscreteBCQPolicy(*table)(other=torch.arange(4))
