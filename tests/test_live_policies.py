"""A live policy acts as its loss has learnt by then; a frozen one as it had when it was made."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any

import pytest
import torch
from helpers import (
    BOUNDS,
    CELLS,
    CRITICS,
    DIMS,
    NO_UPDATER,
    Q,
    discrete_transitions,
    make_bcq_loss,
    make_critics,
    make_discrete_bcq_loss,
    make_distillation_loss,
    make_plas_loss,
    task_transitions,
    total,
    transitions,
)
from tensordict import TensorDict
from torch import Tensor
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import (
    ActionFlow,
    ActionMixture,
    ActionVAE,
    BCQPolicy,
    DiscreteBCQPolicy,
    PLASPolicy,
    make_qvalue_network,
)
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.testing import Case

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
Make = Callable[..., Any]


def case_of(make: Any) -> Case:
    """BCQ over another generator than the autoencoder."""

    def networks() -> dict[str, Any]:
        return {"generator": make(*DIMS, num_cells=CELLS), Q: make_critics(1)[0]}

    return Case(BCQLoss, networks, CRITICS, (Q,), BOUNDS)


CASES: dict[str, tuple[Make, Any, Callable[[], TensorDict]]] = {
    "bcq": (make_bcq_loss, BCQPolicy, lambda: transitions(8)),
    "bcq_one_critic": (partial(make_bcq_loss, num_critics=1), BCQPolicy, lambda: transitions(8)),
    "bcq_perturbed": (
        partial(make_bcq_loss, perturbation=True),
        BCQPolicy,
        lambda: transitions(8),
    ),
    "bcq_over_a_flow": (
        partial(case_of(ActionFlow).make, acting_rule="min"),
        BCQPolicy,
        lambda: transitions(8),
    ),
    "bcq_over_a_mixture": (case_of(ActionMixture).make, BCQPolicy, lambda: transitions(8)),
    "plas": (partial(make_plas_loss, perturbation=True), PLASPolicy, lambda: transitions(8)),
    "discrete": (make_discrete_bcq_loss, DiscreteBCQPolicy, lambda: discrete_transitions(8)),
    "distillation": (make_distillation_loss, BCQPolicy, lambda: task_transitions(3, 5)),
}
every = pytest.mark.parametrize(("make", "policy", "data"), CASES.values(), ids=CASES)


def states(policy: Any, rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(5)
    sizes = {"observation": 3, "task_latent": 2}
    dtype = next(policy.parameters()).dtype
    values = {key: torch.randn(rows, sizes[key], generator=generator) for key in policy.in_keys}
    return TensorDict(values, [rows]).to(dtype)


def act(policy: Any) -> Tensor:
    torch.manual_seed(0)
    return policy(states(policy))["action"]


def train(loss: Any, data: TensorDict) -> None:
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        total(loss(data)).backward()
        optimizer.step()


@every
def test_a_live_policy_is_the_frozen_one_of_each_moment(make: Make, policy: Any, data: Any) -> None:
    loss = make()
    live, frozen = policy.live(loss), policy.frozen(loss)
    before = act(frozen)
    assert torch.equal(act(live), before)
    train(loss, data())
    assert torch.equal(act(frozen), before)
    assert not torch.equal(act(live), before)
    assert torch.equal(act(live), act(policy.frozen(loss)))


@every
def test_a_live_policy_follows_to_another_type_and_loaded_and_replaced_parameters(
    make: Make, policy: Any, data: Any
) -> None:
    loss, other = make(), make(seed=1)
    live = policy.live(loss)
    train(other, data())
    loss.load_state_dict(other.state_dict())
    assert torch.equal(act(live), act(policy.frozen(other)))
    loss.float()
    live.follow()
    assert {p.dtype for p in live.parameters()} == {torch.float32}
    assert torch.equal(act(live), act(policy.frozen(loss)))
    loss = make()
    live = policy.live(loss)
    for name, params in list(other.named_children()):
        if name.endswith("_params") and not name.startswith("target_"):
            setattr(loss, name, params)
    assert torch.equal(act(live), act(policy.frozen(other)))


@every
def test_weights_read_from_a_live_policy_are_the_loss_s(make: Make, policy: Any, data: Any) -> None:
    loss = make()
    live = policy.live(loss)
    held = TensorDict.from_module(live)  # as a collector takes them, once
    train(loss, data())
    expected = TensorDict.from_module(policy.frozen(loss))
    assert set(held.keys(True, True)) == set(expected.keys(True, True))
    assert all(torch.equal(held[key], expected[key]) for key in expected.keys(True, True))
    assert not any(p.requires_grad for p in live.parameters())


@every
@pytest.mark.parametrize("copy", [deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_of_a_live_policy_stands_alone(
    make: Make, policy: Any, data: Any, copy: Any
) -> None:
    loss = make()
    twin = copy(policy.live(loss))
    before = act(twin)
    train(loss, data())
    assert torch.equal(act(twin), before)
    TensorDict.from_module(policy.frozen(loss)).data.to_module(twin)
    assert torch.equal(act(twin), act(policy.live(loss)))


def test_coefficients_that_a_scheduler_changes_reach_the_live_policy() -> None:
    loss = make_bcq_loss(perturbation=True)
    live = BCQPolicy.live(loss)
    before = act(live)
    for name, value in {"latent_clip": 0.1, "max_perturbation": 0.9}.items():
        setattr(loss, name, value)
        assert not torch.equal(act(live), before)
        before = act(live)
    assert torch.equal(act(live), act(BCQPolicy.frozen(loss)))


@every
def test_policies_take_keywords(make: Make, policy: Any, data: Any) -> None:
    acting = policy.frozen(make())
    rows = states(acting)
    expected = act(acting)
    torch.manual_seed(0)
    assert torch.equal(acting(**rows.to_dict()), expected)
    torch.manual_seed(0)
    one = acting(**rows[0].to_dict())
    torch.manual_seed(0)
    assert torch.equal(one, acting(rows[0])["action"])


def bcq_of_the_mock() -> BCQLoss:
    torch.manual_seed(0)
    critics = [make_qvalue_network(7, 7, num_cells=[8]) for _ in range(2)]
    return BCQLoss(ActionVAE(7, 7, num_cells=[8]), critics, bounds=(-1.0, 1.0))


def of_the_mock(*rows: int) -> TensorDict:
    flag = torch.zeros(*rows, 1, dtype=torch.bool)
    after = {"observation": torch.randn(*rows, 7), "reward": torch.rand(*rows, 1)}
    after |= {"done": flag, "terminated": flag}
    values = {"observation": torch.randn(*rows, 7), "action": torch.rand(*rows, 7) * 2 - 1}
    return TensorDict(values | {"next": after}, list(rows))


def actions_agree(data: TensorDict, loss: BCQLoss) -> bool:
    """Whether one candidate's actions, decoded from z = 0, are the loss's."""
    policy = BCQPolicy.frozen(loss, num_candidates=1)
    policy.latent_clip = 0.0
    return torch.allclose(policy(data.select("observation"))["action"], data["action"], atol=1e-6)


def make_mock_env() -> EnvBase:
    return ContinuousActionVecMockEnv()


def test_a_collector_acts_with_what_the_loss_has_learnt() -> None:
    loss = bcq_of_the_mock()
    loss.latent_clip = 0.0
    live = BCQPolicy.live(loss, num_candidates=1)
    collector = Collector(make_mock_env(), live, frames_per_batch=10, total_frames=30)
    for batch in collector:
        assert actions_agree(batch, loss)
        train(loss, of_the_mock(8))
    collector.shutdown()


@pytest.mark.slow
def test_workers_of_a_collector_act_with_the_weights_that_they_are_sent() -> None:
    loss = bcq_of_the_mock()
    loss.latent_clip = 0.0
    live = BCQPolicy.live(loss, num_candidates=1)
    start = deepcopy(loss)
    collector = MultiSyncCollector(
        [make_mock_env], live, frames_per_batch=10, total_frames=30, update_at_each_batch=False
    )
    batches = iter(collector)
    assert actions_agree(next(batches), start)
    train(loss, of_the_mock(8))
    collector.update_policy_weights_()
    assert actions_agree(next(batches), loss)
    collector.shutdown()


def test_losses_without_the_policy_are_refused_by_name() -> None:
    stack = StackedLoss([make_bcq_loss(seed=seed) for seed in range(2)])
    for make in (BCQPolicy.live, BCQPolicy.frozen):
        with pytest.raises(BMRLError, match=r"StackedLoss has 2 policies; valid: .*member"):
            make(stack)
    with pytest.raises(BMRLError, match="BCQLoss has no actor_network; valid"):
        PLASPolicy.live(make_bcq_loss())
    with pytest.raises(BMRLError, match=r"PLASLoss acts by its actor_network.*valid: PLASPolicy"):
        BCQPolicy.live(make_plas_loss())
    loss = make_plas_loss()
    loss.actor_network.out_keys = ["action"]
    with pytest.raises(BMRLError, match=r"writes \['action'\]; valid: 'action_latent'"):
        PLASPolicy.frozen(loss)
    assert act(BCQPolicy.frozen(stack.member(1))).shape == (64, 2)
