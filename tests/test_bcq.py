"""BCQLoss: its numbers, its candidates and its options."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    make_bcq_loss,
    make_critics,
    make_generator,
    run,
    transitions,
    undeclare,
)
from recomputed import numpy_decoder, numpy_mlp, recorded
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GAMMA, LMBDA, CANDIDATES = 0.99, 0.75, 6


def expected_next_value(loss: BCQLoss, latent: Tensor, data: TensorDict) -> np.ndarray:
    """Value of the next states for given latents ``(*B, candidates, latent_dim)``, in numpy."""
    observation = data["next", "observation"].numpy()[..., None, :]
    observation = np.broadcast_to(observation, (*latent.shape[:-1], OBSERVATION_DIM))
    action = numpy_decoder(loss.generator_params["decoder"], observation, latent)
    if loss.perturbation_network is not None:
        network = loss.target_perturbation_network_params["module", "network"]
        moved = action + 0.4 * 0.25 * np.tanh(numpy_mlp(network, observation, action))
        action = np.clip(moved, -0.25, 0.25)
    targets = loss.target_qvalue_network_params["module"]
    q = np.stack([numpy_mlp(targets[j], observation, action)[..., 0] for j in (0, 1)])
    return (LMBDA * q.min(0) + (1 - LMBDA) * q.max(0)).max(-1)


# -- the critics' target -----------------------------------------------------------------------


@pytest.mark.parametrize("perturbation", [False, True])
@pytest.mark.parametrize("batch", [(8,), (2, 4)])
def test_qvalue_loss_is_that_of_the_equations(perturbation: bool, batch: tuple[int, ...]) -> None:
    # A decoder of the user's may reach beyond the bounds, which then clip what is perturbed.
    options = {"max_perturbation": 0.4, "bounds": (-0.25, 0.25)} if perturbation else {}
    options |= {"edit": undeclare}
    loss = make_bcq_loss(
        perturbation=perturbation, num_candidates=CANDIDATES, gamma=GAMMA, lmbda=LMBDA, **options
    )
    data = transitions(*batch)
    calls = recorded(loss.generator.decoder.module)
    value, info = loss.qvalue_loss(data)

    ((observation, latent), _), *_ = calls
    assert observation.shape == (*batch, CANDIDATES, OBSERVATION_DIM)
    assert torch.equal(observation[..., 0, :], data["next", "observation"])
    next_value = expected_next_value(loss, latent, data)
    alive = 1.0 - data["next", "terminated"].squeeze(-1).double().numpy()
    target = data["next", "reward"].squeeze(-1).numpy() + GAMMA * alive * next_value
    critics = loss.qvalue_network_params["module"]
    predicted = np.stack(
        [numpy_mlp(critics[j], data["observation"], data["action"])[..., 0] for j in (0, 1)]
    )
    error = (predicted - target) ** 2
    np.testing.assert_allclose(value.item(), error.sum(0).mean(), rtol=1e-10)
    np.testing.assert_allclose(info["td_error"], error, rtol=1e-10)
    np.testing.assert_allclose(info["pred_value"], predicted.mean(), rtol=1e-10)
    np.testing.assert_allclose(info["target_value"], target.mean(), rtol=1e-10)
    np.testing.assert_allclose(info["next_state_value"], next_value.mean(), rtol=1e-10)


@pytest.mark.parametrize("through", ["method", "forward"])
@pytest.mark.parametrize("exploration", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_candidates_differ_within_a_state(through: str, exploration: ExplorationType) -> None:
    loss = make_bcq_loss(num_candidates=CANDIDATES, latent_clip=None)
    calls = recorded(loss.generator.decoder.module)
    with set_exploration_type(exploration):
        (loss.qvalue_loss if through == "method" else loss)(transitions(8))
    # forward reconstructs the data's actions before it proposes candidates
    ((_, latent), action), *_ = (call for call in calls if call[1].ndim == 3)
    assert latent.shape == (8, CANDIDATES, LATENT_DIM)
    for candidates in (*latent, *action):
        assert len(candidates.unique(dim=0)) == CANDIDATES
    assert (action.std(1) > 1e-3).all()


def test_generator_loss_samples_the_posterior_inside_a_deterministic_context() -> None:
    loss = make_bcq_loss()
    data = transitions(8)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        values = {loss.generator_loss(data)[0].item() for _ in range(4)}
    assert len(values) == 4


@pytest.mark.parametrize("clip", [0.5, None])
def test_latents_of_candidates_are_clipped_only_if_asked(clip: float | None) -> None:
    loss = make_bcq_loss(latent_clip=clip, num_candidates=50)
    calls = recorded(loss.generator.decoder.module)
    loss.qvalue_loss(transitions(8))
    largest = calls[0][0][1].abs().max()
    assert largest > 2 if clip is None else largest == 0.5


def test_candidates_of_the_target_are_perturbed_in_every_dimension_within_the_bounds() -> None:
    loss = make_bcq_loss(
        perturbation=True,
        deactivate_vmap=True,
        max_perturbation=0.4,
        bounds=(torch.tensor([-0.3, -0.2]), torch.tensor([0.1, 0.2])),
        edit=undeclare,
    )
    proposed = recorded(loss.generator.decoder.module)
    perturbations = recorded(loss.perturbation_network.module)
    judged = recorded(loss.qvalue_network.module)
    loss.qvalue_loss(transitions(8))
    action, perturbation = proposed[0][1], perturbations[0][1]
    seen = judged[0][0][1]
    assert perturbation.shape == seen.shape == (8, 10, ACTION_DIM)
    assert (perturbation[..., 0] != perturbation[..., 1]).all()
    moved = action + 0.4 * (0.5 * (loss.action_high - loss.action_low)) * perturbation
    assert torch.equal(seen, moved.clamp(loss.action_low, loss.action_high))
    assert (seen != moved).any()
    assert (seen != action).any(0).all()


def test_candidates_come_from_the_trained_generator_and_targets_from_target_critics() -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(8)

    def target() -> float:
        torch.manual_seed(0)
        return loss.qvalue_loss(data)[1]["target_value"].item()

    def moves(params: Any) -> bool:
        before = target()
        for value in params.values(True, True):
            value.data.mul_(1.5)
        return target() != before

    assert moves(loss.generator_params)
    assert moves(loss.target_qvalue_network_params)
    assert moves(loss.target_perturbation_network_params)
    assert not moves(loss.qvalue_network_params)
    assert not moves(loss.perturbation_network_params)
    assert "target_generator_params" not in dict(loss.named_children())


@pytest.mark.parametrize(
    ("name", "distance"),
    [
        ("l2", np.square),
        ("l1", np.abs),
        ("smooth_l1", lambda d: np.where(np.abs(d) < 1, 0.5 * d**2, np.abs(d) - 0.5)),
    ],
)
def test_loss_function_is_the_distance_between_value_and_target(
    name: str, distance: Callable[[np.ndarray], np.ndarray]
) -> None:
    loss = make_bcq_loss(loss_function=name, reduction="none")
    data = transitions(8)
    data["next", "reward"].mul_(3)
    value, info = loss.qvalue_loss(data)
    difference = info["td_error"].sqrt().numpy()
    assert difference.min() < 1 < difference.max()
    np.testing.assert_allclose(value.detach(), distance(difference).sum(0), rtol=1e-10)


@pytest.mark.parametrize("bounds", [(-0.01, 0.01), (-100.0, 100.0)])
def test_value_bounds_clamp_the_value_of_the_next_states(bounds: tuple[float, float]) -> None:
    data = transitions(8)
    data["next", "reward"].zero_()
    data["next", "terminated"].zero_()
    free, bounded = make_bcq_loss(gamma=GAMMA), make_bcq_loss(gamma=GAMMA, value_bounds=bounds)
    values = []
    for loss in (free, bounded):
        for parameter in loss.qvalue_network_params.values(True, True):
            parameter.data.zero_()  # prediction 0: the priority is the squared target
        run(loss, data)
        values.append(data["td_error"].sqrt() / GAMMA)
    assert values[0].min() < values[0].max() < 100
    assert values[0].max() > 0.01
    torch.testing.assert_close(values[1], values[0].clamp(max=bounds[1]))


# -- the other losses --------------------------------------------------------------------------


def test_generator_loss_is_reconstruction_plus_weighted_divergence() -> None:
    loss = make_bcq_loss(kl_weight=0.3)
    data = transitions(8)
    calls = recorded(loss.generator.decoder.module)
    torch.manual_seed(3)
    value, info = loss.generator_loss(data)

    observation, action = data["observation"].numpy(), data["action"].numpy()
    posterior = numpy_mlp(
        loss.generator_params["encoder", "module", "network"], observation, action
    )
    loc, scale = posterior[:, :LATENT_DIM], np.exp(posterior[:, LATENT_DIM:])
    (_, latent), _ = calls[0]
    noise = (latent.numpy() - loc) / scale
    torch.manual_seed(3)
    np.testing.assert_allclose(noise, torch.randn(8, LATENT_DIM, dtype=torch.float64), rtol=1e-8)
    decoded = numpy_decoder(loss.generator_params["decoder"], observation, latent)
    reconstruction = ((decoded - action) ** 2).mean()
    divergence = (0.5 * (loc**2 + scale**2 - 1) - np.log(scale)).mean()
    np.testing.assert_allclose(info["reconstruction_error"], reconstruction, rtol=1e-10)
    np.testing.assert_allclose(info["kl_divergence"], divergence, rtol=1e-10)
    np.testing.assert_allclose(value.item(), reconstruction + 0.3 * divergence, rtol=1e-10)


def test_the_sum_of_the_divergence_is_its_mean_times_the_size_of_the_latent() -> None:
    results = []
    for reduction in ("mean", "sum"):
        loss = make_bcq_loss(kl_reduction=reduction, kl_weight=0.3)
        results.append(run(loss, transitions(8)))
    mean, summed = results
    torch.testing.assert_close(summed["kl_divergence"], LATENT_DIM * mean["kl_divergence"])
    assert torch.equal(summed["reconstruction_error"], mean["reconstruction_error"])
    difference = summed["loss_generator"] - mean["loss_generator"]
    torch.testing.assert_close(difference, 0.3 * (LATENT_DIM - 1) * mean["kl_divergence"])


def test_perturbation_loss_is_minus_the_first_critic_at_the_perturbed_proposal() -> None:
    options = {"max_perturbation": 0.4, "bounds": (-0.25, 0.25), "edit": undeclare}
    loss = make_bcq_loss(perturbation=True, **options)
    data = transitions(8)
    calls = recorded(loss.generator.decoder.module)
    value, _ = loss.perturbation_loss(data)
    observation, latent = (value.squeeze(-2) for value in calls[0][0])
    assert torch.equal(observation, data["observation"])
    action = numpy_decoder(loss.generator_params["decoder"], observation, latent)
    network = loss.perturbation_network_params["module", "network"]
    moved = action + 0.4 * 0.25 * np.tanh(numpy_mlp(network, observation, action))
    action = np.clip(moved, -0.25, 0.25)
    q = numpy_mlp(loss.qvalue_network_params["module"][0], observation, action)
    np.testing.assert_allclose(value.item(), -q.mean(), rtol=1e-10)


def test_perturbation_loss_without_a_network_is_refused() -> None:
    with pytest.raises(BMRLError, match="without a perturbation_network"):
        make_bcq_loss().perturbation_loss(transitions(8))


# -- construction ------------------------------------------------------------------------------


def test_targets_start_as_copies_of_the_critics_that_were_given() -> None:
    torch.manual_seed(0)
    generator, critics = make_generator(torch.float64), make_critics(3, torch.float64)
    loss = BCQLoss(generator, critics, bounds=(-1.0, 1.0))
    target = loss.target_qvalue_network_params["module", "0", "weight"]
    assert torch.equal(target, torch.stack([critic.module[0].weight for critic in critics]))


SPEC = Bounded(low=torch.tensor([-1.0, -2.0]), high=torch.tensor([0.5, 3.0]), shape=(2,))


@pytest.mark.parametrize("spec", [SPEC, Composite(action=SPEC)])
def test_bounds_may_come_from_the_action_spec(spec: Any) -> None:
    loss = make_bcq_loss(bounds=None, action_spec=spec, edit=undeclare)
    assert loss.action_low.tolist() == [-1.0, -2.0]
    assert loss.action_high.tolist() == [0.5, 3.0]
    assert {"action_low", "action_high"} <= loss.state_dict().keys()


def test_critics_of_other_structure_keep_it() -> None:
    torch.manual_seed(0)
    narrow, wide = (make_qvalue_network(3, 2, num_cells=cells) for cells in ((8,), (16, 16)))
    swapped = TensorDictModule(
        lambda action, observation: observation.sum(-1, keepdim=True) * action[..., :1],
        in_keys=["action", "observation"],
        out_keys=["state_action_value"],
    )
    loss = BCQLoss(ActionVAE(3, 2), [narrow, wide, swapped], bounds=(-1.0, 1.0))
    data = transitions(8, dtype=torch.float32)
    for own, critic in zip(loss.qvalue(data), (narrow, wide, swapped), strict=True):
        expected = critic(data.select("observation", "action"))["state_action_value"].squeeze(-1)
        torch.testing.assert_close(own, expected)
    trained = {id(parameter) for parameter in loss.parameters()}
    assert all(id(p) in trained for critic in (narrow, wide) for p in critic.parameters())


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((float("nan"), 1.0), "bounds of the action are nan and 1.0; valid: finite numbers"),
        ((torch.zeros(4, 2), torch.ones(4, 2)), r"shapes \(4, 2\) and \(4, 2\); valid"),
    ],
)
def test_bounds_that_are_none_are_refused(bounds: Any, message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        make_bcq_loss(bounds=bounds)


def test_a_network_that_writes_another_key_or_has_none_is_named() -> None:
    critic = make_qvalue_network(3, 2)
    critic = TensorDictModule(critic.module, in_keys=critic.in_keys, out_keys=["q"])
    loss = BCQLoss(ActionVAE(3, 2), critic, bounds=(-1.0, 1.0))
    with pytest.raises(BMRLError, match=r"writes \['q'\], not 'state_action_value'"):
        loss(transitions(8, dtype=torch.float32))
    with pytest.raises(BMRLError, match="qvalue_network is a Linear; valid: a TensorDictModule"):
        BCQLoss(ActionVAE(3, 2), torch.nn.Linear(3, 2), bounds=(-1.0, 1.0))


# -- targets in another type -----------------------------------------------------------------------
