"""DiscreteBCQLoss: its threshold, how actions are written, and the policy that acts like it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    NO_UPDATER,
    NUM_ACTIONS,
    as_keywords,
    discrete_transitions,
    make_discrete_bcq_loss,
    run,
    state,
)
from recomputed import numpy_mlp
from tensordict import TensorDict

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import DiscreteBCQPolicy
from torchrl_bmrl.objectives import DiscreteBCQLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GAMMA = 0.99


def outputs(loss: DiscreteBCQLoss, observation: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Probabilities of the actions, and their values under critics and targets, in numpy."""
    logits = numpy_mlp(loss.generator_params["module"], observation)
    probability = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    values = []
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        single = loss.num_qvalue_nets == 1
        critics = [params["critics", "0", "module"]] if single else list(params["module"].unbind(0))
        values.append(np.stack([numpy_mlp(critic, observation) for critic in critics]))
    return probability, *values


def picked(value: np.ndarray, index: np.ndarray) -> np.ndarray:
    return np.take_along_axis(value, index[..., None], -1)[..., 0]


def target_of(loss: DiscreteBCQLoss, data: TensorDict, allowed: np.ndarray) -> np.ndarray:
    """Double DQN's target within the allowed actions, under the ensemble's minimum."""
    _, value, target = outputs(loss, data["next", "observation"])
    best = np.where(allowed, value.min(0), -np.inf).argmax(-1)
    alive = 1.0 - data["next", "terminated"].squeeze(-1).double().numpy()
    return data["next", "reward"].squeeze(-1).numpy() + GAMMA * alive * picked(target.min(0), best)


def check(loss: DiscreteBCQLoss, data: TensorDict, target: np.ndarray) -> None:
    _, info = loss.qvalue_loss(data)
    np.testing.assert_allclose(info["target_value"], target.mean(), rtol=1e-10)
    _, value, _ = outputs(loss, data["observation"])
    index = data["action"].argmax(-1).numpy()
    for j, row in enumerate(value):
        error = (picked(row, index) - target) ** 2
        np.testing.assert_allclose(info["td_error"][j], error, rtol=1e-10)


@pytest.mark.parametrize("threshold", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("batch", [(64,), (4, 16)])
def test_target_takes_the_best_of_the_likely_actions(
    threshold: float, batch: tuple[int, ...]
) -> None:
    loss = make_discrete_bcq_loss(threshold=threshold, gamma=GAMMA)
    data = discrete_transitions(*batch)
    probability, *_ = outputs(loss, data["next", "observation"])
    ratio = probability / probability.max(-1, keepdims=True)
    likely = ratio > threshold
    if threshold == 0:  # Double DQN over all actions
        assert likely.all()
    elif threshold == 1:  # the likeliest one alone
        likely = ratio == 1
        assert (likely.sum(-1) == 1).all()
    else:
        assert set(likely.sum(-1).flatten()) == {1, 2, 3}
    check(loss, data, target_of(loss, data, likely))


def test_thresholds_lead_to_different_targets() -> None:
    data = discrete_transitions(64)
    losses = [make_discrete_bcq_loss(threshold=threshold) for threshold in (0.0, 0.7, 1.0)]
    assert len({run(loss, data)["target_value"].item() for loss in losses}) == 3


@pytest.mark.parametrize("number", [1, 3])
def test_several_critics_are_clipped_to_their_minimum_and_one_is_double_dqn(number: int) -> None:
    loss = make_discrete_bcq_loss(num_critics=number, threshold=0.0, gamma=GAMMA)
    data = discrete_transitions(32)
    _, _, target = outputs(loss, data["next", "observation"])
    assert len(set(target.argmin(0).flatten())) == number  # each is the least somewhere
    check(loss, data, target_of(loss, data, np.full((32, NUM_ACTIONS), True)))


def test_generator_loss_is_cross_entropy_plus_weighted_squared_logits() -> None:
    loss = make_discrete_bcq_loss(logits_weight=0.3, reduction="none")
    data = discrete_transitions(8)
    value, info = loss.generator_loss(data)
    probability, *_ = outputs(loss, data["observation"])
    logits = numpy_mlp(loss.generator_params["module"], data["observation"])
    cross_entropy = -np.log(picked(probability, data["action"].argmax(-1).numpy()))
    np.testing.assert_allclose(info["cross_entropy"], cross_entropy.mean(), rtol=1e-10)
    expected = cross_entropy + 0.3 * (logits**2).mean(-1)
    np.testing.assert_allclose(value.detach(), expected, rtol=1e-10)


# -- how actions are written -------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(8,), (2, 4)])
@pytest.mark.parametrize("trailing", [False, True])
@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float64])
def test_one_hot_and_categorical_actions_give_the_same_losses(
    batch: tuple[int, ...], trailing: bool, dtype: torch.dtype
) -> None:
    data = discrete_transitions(*batch)
    categorical = discrete_transitions(*batch, action_space="categorical")
    assert torch.equal(data["action"].argmax(-1), categorical["action"])
    data["action"] = data["action"].to(dtype)
    if trailing:
        categorical["action"] = categorical["action"].unsqueeze(-1)
    loss = make_discrete_bcq_loss()
    other = make_discrete_bcq_loss(action_space="categorical")
    expected = run(loss, data)
    assert (run(other, categorical) == expected).all()
    assert torch.equal(categorical["td_error"], data["td_error"])
    torch.manual_seed(0)
    keywords = other(**as_keywords(categorical, other.in_keys))
    assert all(map(torch.equal, keywords, expected.values()))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_one_hot_numbers_that_are_not_finite_are_refused(bad: float) -> None:
    data = discrete_transitions(8)
    data["action"] = data["action"].double()
    data["action"][3, 1] = bad
    with pytest.raises(BMRLError, match=r"'action'.*finite"):
        make_discrete_bcq_loss()(data)


@pytest.mark.parametrize("index", [-1, NUM_ACTIONS])
def test_an_action_that_does_not_exist_is_refused(index: int) -> None:
    data = discrete_transitions(8, action_space="categorical")
    data["action"][3] = index
    with pytest.raises(BMRLError, match=f"'action'.*{index}.*valid"):
        make_discrete_bcq_loss(action_space="categorical")(data)


# -- acting ------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_space", ["one-hot", "categorical"])
@pytest.mark.parametrize("number", [1, 2])
def test_the_policy_of_a_loss_takes_the_best_likely_action_and_is_a_copy(
    action_space: str, number: int
) -> None:
    loss = make_discrete_bcq_loss(
        action_space=action_space, num_critics=number, threshold=0.7, reduction="none"
    )
    policy = DiscreteBCQPolicy.frozen(loss)
    data = discrete_transitions(64, action_space=action_space)

    def act() -> np.ndarray:
        action = policy(data.select("observation"))["action"]
        assert action.shape == ((64, NUM_ACTIONS) if action_space == "one-hot" else (64,))
        return (action.argmax(-1) if action_space == "one-hot" else action).numpy()

    logits = numpy_mlp(loss.generator_params["module"], data["observation"])
    likely = np.exp(logits - logits.max(-1, keepdims=True)) > 0.7
    params = loss.critic(0)[1]["module"]
    value = numpy_mlp(params, data["observation"])
    action = act()
    assert np.array_equal(action, np.where(likely, value, -np.inf).argmax(-1))
    assert picked(likely, action).all()
    assert (action != value.argmax(-1)).any()
    before = state(policy)
    for parameter in loss.parameters():
        parameter.data.mul_(-1.0)
    assert np.array_equal(act(), action)
    assert all(torch.equal(value, before[key]) for key, value in state(policy).items())
