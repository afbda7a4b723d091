"""PLASLoss: its target, its actor's loss, and the policy that acts like it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    make_plas_loss,
    run,
    state,
    transitions,
    undeclare,
)
from recomputed import numpy_decoder, numpy_mlp, recorded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_bmrl.modules import PLASPolicy, make_latent_actor
from torchrl_bmrl.objectives import PLASLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GAMMA, LMBDA = 0.99, 0.75
# Decoded actions reach beyond these bounds, so that clipping shows.
BOUNDS = {"bounds": (-0.25, 0.25), "edit": undeclare}
PERTURBED = {"perturbation": True, "max_perturbation": 0.4, **BOUNDS}
both = pytest.mark.parametrize("options", [{}, PERTURBED], ids=["plain", "perturbed"])


def acted(loss: PLASLoss, observation: np.ndarray, prefix: str = "") -> np.ndarray:
    """The policy's action, or its target's, in numpy."""

    def params(name: str) -> Any:
        return getattr(loss, f"{prefix}{name}_params")["module", "network"]

    latent = 2.0 * np.tanh(numpy_mlp(params("actor_network"), observation))
    action = numpy_decoder(loss.generator_params["decoder"], observation, latent)
    if loss.perturbation_network is None:
        return action
    perturbation = np.tanh(numpy_mlp(params("perturbation_network"), observation, action))
    return np.clip(action + 0.4 * 0.25 * perturbation, -0.25, 0.25)


@both
@pytest.mark.parametrize("batch", [(8,), (2, 4)])
def test_target_is_the_mixed_value_of_the_target_policy_s_action(
    options: dict[str, Any], batch: tuple[int, ...]
) -> None:
    loss, data = make_plas_loss(gamma=GAMMA, lmbda=LMBDA, **options), transitions(*batch)
    _, info = loss.qvalue_loss(data)
    observation = data["next", "observation"].numpy()
    action = acted(loss, observation, "target_")
    critics = loss.target_qvalue_network_params["module"]
    q = np.stack([numpy_mlp(critics[j], observation, action)[..., 0] for j in (0, 1)])
    next_value = LMBDA * q.min(0) + (1 - LMBDA) * q.max(0)
    alive = 1.0 - data["next", "terminated"].squeeze(-1).double().numpy()
    target = data["next", "reward"].squeeze(-1).numpy() + GAMMA * alive * next_value
    np.testing.assert_allclose(info["next_state_value"], next_value.mean(), rtol=1e-10)
    np.testing.assert_allclose(info["target_value"], target.mean(), rtol=1e-10)
    critics = loss.qvalue_network_params["module"]
    for j in (0, 1):
        predicted = numpy_mlp(critics[j], data["observation"], data["action"])[..., 0]
        np.testing.assert_allclose(info["td_error"][j], (predicted - target) ** 2, rtol=1e-10)


def test_one_action_per_next_state_is_judged_and_nothing_is_drawn() -> None:
    loss, data = make_plas_loss(), transitions(8)
    decoded = recorded(loss.generator.decoder.module)
    values = {loss.qvalue_loss(data)[0].item() for _ in range(3)}
    assert len(values) == 1
    assert decoded[0][1].shape == (8, ACTION_DIM)


def test_target_follows_generator_and_targets_alone() -> None:
    loss, data = make_plas_loss(perturbation=True), transitions(8)

    def moves(name: str) -> bool:
        before = loss.qvalue_loss(data)[1]["target_value"]
        for value in getattr(loss, name).values(True, True):
            value.data.mul_(1.5)
        return not torch.equal(loss.qvalue_loss(data)[1]["target_value"], before)

    networks = ("actor_network", "perturbation_network", "qvalue_network")
    assert moves("generator_params")
    assert [moves(f"target_{name}_params") for name in networks] == [True] * 3
    assert [moves(f"{name}_params") for name in networks] == [False] * 3


@both
@pytest.mark.parametrize("exploration", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_actor_loss_is_minus_the_first_critic_at_the_policy_s_action(
    options: dict[str, Any], exploration: ExplorationType
) -> None:
    loss, data = make_plas_loss(reduction="none", **options), transitions(8)
    with set_exploration_type(exploration):
        value, _ = loss.actor_loss(data)
    observation = data["observation"].numpy()
    critic = loss.qvalue_network_params["module"][0]
    expected = -numpy_mlp(critic, observation, acted(loss, observation))[..., 0]
    np.testing.assert_allclose(value.detach(), expected, rtol=1e-10)


@both
def test_the_policy_of_a_loss_acts_like_it_and_is_a_copy(options: dict[str, Any]) -> None:
    loss, data = make_plas_loss(**options), transitions(8)
    policy = PLASPolicy.frozen(loss)
    before = state(policy)
    action = policy(data.clone())["action"]
    expected = acted(loss, data["observation"].numpy())
    np.testing.assert_allclose(action, expected, rtol=1e-10)
    assert torch.equal(action, loss.act(data.select("observation"))["action"])
    for parameter in loss.parameters():
        parameter.data.add_(1.0)
    assert torch.equal(policy(data.clone())["action"], action)
    assert before.keys() == state(policy).keys() != set()
    assert not any(parameter.requires_grad for parameter in policy.parameters())


@pytest.mark.parametrize("max_latent", [2.0, 0.5])
def test_a_latent_actor_stays_within_its_bound_and_comes_near_it(max_latent: float) -> None:
    torch.manual_seed(0)
    actor = make_latent_actor(OBSERVATION_DIM, LATENT_DIM, num_cells=(8,), max_latent=max_latent)
    latent = actor(100 * transitions(200, dtype=torch.float32).select("observation"))
    assert latent["action_latent"].shape == (200, LATENT_DIM)
    assert 0.95 * max_latent < latent["action_latent"].abs().max() <= max_latent


def test_the_actor_trains_through_a_generator_that_is_held() -> None:
    loss, data = make_plas_loss(), transitions(16)
    generator = state(loss.generator_params)
    critics = state(loss.qvalue_network_params)
    optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), lr=1e-2)
    first = run(loss, data)["loss_actor"]
    for _ in range(50):
        optimizer.zero_grad()
        loss.actor_loss(data)[0].backward()
        optimizer.step()
    assert run(loss, data)["loss_actor"] < first - 0.01
    assert all(torch.equal(v, generator[k]) for k, v in state(loss.generator_params).items())
    assert all(torch.equal(v, critics[k]) for k, v in state(loss.qvalue_network_params).items())
