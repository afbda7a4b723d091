"""FOCAL: what trains its encoder, and what its actor does with the context of a new task."""

from __future__ import annotations

import pytest
import torch
from helpers import NO_UPDATER, make_focal_loss, reached, refused, task_data
from point_mass import GOALS, HELD_OUT, nearness, point_mass
from tensordict import TensorDict
from torchrl.modules import TanhNormal
from torchrl.objectives import SoftUpdate

from torchrl_bmrl import modules
from torchrl_bmrl.behaviour import dual_kl, squashed_gaussian
from torchrl_bmrl.modules import embed_context, extract_network
from torchrl_bmrl.objectives import FOCALLoss
from torchrl_bmrl.objectives.contexts import Embedded

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


def make_loss() -> FOCALLoss:
    """A loss for the point mass, whose rewards are about -1."""
    latent = {"task_latent_dim": 4, "num_cells": (32, 32)}
    encoder = modules.make_context_encoder(
        2, 2, 4, pooling="mean", num_features=16, num_cells=(32, 32)
    )
    encoder.module.set_scales(point_mass(GOALS, 48, seed=2000).flatten())
    return FOCALLoss(
        encoder,
        modules.make_gaussian_actor(2, 2, **latent),
        modules.make_qvalue_network(2, 2, **latent),
        modules.make_qvalue_network(2, 2, **latent),
        bounds=(-1.0, 1.0),
        context_size=16,
        entropy_weight=0.02,
        divergence_weight=0.1,
        gamma=0.8,
    )


def train(loss: FOCALLoss, updates: int, *terms: str) -> None:
    targets = SoftUpdate(loss, tau=0.02)
    optimizers = {
        term: torch.optim.Adam(getattr(loss, f"{name}_params").parameters(), lr=2e-3)
        for term, name in {
            "encoder": "task_encoder",
            "divergence": "divergence_network",
            "qvalue": "qvalue_network",
            "actor": "actor_network",
        }.items()
        if term in terms
    }
    for update in range(updates):
        data = point_mass(GOALS, 48, seed=update)
        for term, optimizer in optimizers.items():
            value, _ = getattr(loss, f"{term}_loss")(data)
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
        targets.step()


# -- equations -------------------------------------------------------------------------------------


def test_the_action_and_its_density_are_those_of_torchrl() -> None:
    torch.manual_seed(0)
    loc, scale, noise = (0.5 * torch.randn(50, 2, dtype=torch.float64) for _ in range(3))
    low, high = torch.tensor([[-1.0, 0.5], [2.0, 3.0]], dtype=torch.float64)
    action, density = squashed_gaussian(loc, scale.exp(), noise, low, high)
    expected = TanhNormal(loc, scale.exp(), low=low, high=high, event_dims=1, upscale=100.0)
    torch.testing.assert_close(density, expected.log_prob(action), rtol=1e-4, atol=1e-4)
    assert bool(((action > low) & (action < high)).all())


def test_an_action_at_a_bound_has_a_finite_density() -> None:
    far = torch.full((1,), 50.0)
    action, density = squashed_gaussian(far, far / far, far * 0, -far / far, far / far)
    assert action.item() == 1.0
    assert density.isfinite()


def test_the_divergence_is_that_of_two_gaussians_where_the_classifier_is_their_ratio() -> None:
    torch.manual_seed(0)
    policy = torch.distributions.Normal(0.3, 0.8)
    data = torch.distributions.Normal(0.0, 1.0)

    def logit(action: torch.Tensor) -> torch.Tensor:
        return (policy.log_prob(action) - data.log_prob(action)).exp().expm1().log()

    estimate = dual_kl(logit(policy.sample((100_000,))), logit(data.sample((100_000,)))).mean()
    expected = torch.distributions.kl_divergence(policy, data)
    assert estimate.item() == pytest.approx(expected.item(), abs=0.02)


# -- the loss --------------------------------------------------------------------------------------


def test_the_distances_alone_train_the_encoder() -> None:
    for term in FOCALLoss.terms:
        loss = make_focal_loss()
        getattr(loss, f"{term}_loss")(task_data(3, 6))[0].backward()
        assert ("task_encoder" in reached(loss)) == (term == "encoder")


def test_a_row_is_never_in_its_own_context() -> None:
    loss = make_focal_loss(context_size=3)
    data = task_data(3, 6)
    row = torch.zeros(3, 6, 3, dtype=torch.float64)
    for number in range(6):
        data["observation"] = row.clone()
        torch.manual_seed(0)
        before = loss.embed(data)[0]
        data["observation"][:, number] = 5.0
        torch.manual_seed(0)
        assert torch.equal(loss.embed(data)[0][:, number], before[:, number])


@pytest.mark.parametrize("last", [1, 6])
def test_padding_changes_no_loss_whatever_it_holds(last: int) -> None:
    losses = []
    for value in (0.0, 0.5, float("nan")):
        loss, data = make_focal_loss(context_size=2), task_data(3, 6)
        mask = torch.ones(3, 6, 1, dtype=torch.bool)
        mask[0, :last] = False
        for key, found in list(data.items(True, True)):
            if found.is_floating_point():
                data[key] = torch.where(mask, found, value)
        data["collector", "mask"] = mask
        torch.manual_seed(0)
        losses.append(loss(data))
        assert losses[-1].isfinite().all()
    for other in losses[1:]:
        for key, found in other.items():
            torch.testing.assert_close(found, losses[0][key], msg=key)


def test_a_task_of_padding_alone_moves_the_encoder_of_no_other_task() -> None:
    loss, data = make_focal_loss(), task_data(4, 6)
    mask = torch.ones(4, 6, 1, dtype=torch.bool)
    mask[2] = False
    data["collector", "mask"] = mask
    points = torch.randn(4, 3, 2, dtype=torch.float64)
    valid = mask[:, :3, 0]
    found = []
    for _ in range(2):
        loss.embed = lambda _: Embedded(points, points, valid)  # type: ignore[method-assign]
        torch.manual_seed(0)
        found.append(loss.encoder_loss(data)[0])
        points[2] += 1.0
    assert torch.equal(*found)


def test_padded_rows_have_no_priority() -> None:
    loss, data = make_focal_loss(), task_data(3, 6)
    mask = torch.arange(18).view(3, 6, 1) % 3 > 0
    data["collector", "mask"] = mask
    loss(data)
    assert torch.equal(data["td_error"] > 0, mask.squeeze(-1))


def test_the_weight_of_the_divergence_follows_its_target_within_its_limits() -> None:
    loss = make_focal_loss(target_divergence=0.5, max_divergence_weight=2.0)
    for divergence, weight in [(1.5, 1.2), (100.0, 2.0), (-100.0, 0.0)]:
        loss.adapt_divergence_weight(torch.tensor(divergence, dtype=torch.float64))
        assert loss.divergence_weight.item() == pytest.approx(weight)


def test_an_encoder_that_reads_a_reward_under_its_old_name_is_refused() -> None:
    """Although the data have both; critics and encoder would read different rewards."""
    loss, data = make_focal_loss(), task_data(3, 6)
    loss.set_keys(reward="scaled")
    data["next", "scaled"] = 2 * data["next", "reward"]
    with refused("reward='scaled'.* what task_encoder read"):
        loss(data)


@pytest.mark.parametrize("shape", [(6,), (1, 6), (2, 3, 6)])
def test_batches_without_two_tasks_are_refused(shape: tuple[int, ...]) -> None:
    with refused("batch size is .* valid: .*num_tasks, B.*, two tasks or more"):
        make_focal_loss()(task_data(*shape))


def test_batches_without_two_contexts_are_refused() -> None:
    with refused("3 rows per task and context_size is 2; valid: .* 4 rows"):
        make_focal_loss()(task_data(3, 3))


def test_an_encoder_of_single_transitions_is_refused() -> None:
    latent = {"task_latent_dim": 2}
    critics = (modules.make_qvalue_network(3, 2, **latent) for _ in range(2))
    actor = modules.make_gaussian_actor(3, 2, **latent)
    with refused("task_encoder reads .*; valid: an encoder of sets"):
        FOCALLoss(modules.make_task_encoder(3, 2, 2), actor, *critics, bounds=(-1.0, 1.0))


# -- a family of tasks -----------------------------------------------------------------------------


def test_contexts_of_one_task_get_nearer_than_those_of_others() -> None:
    torch.manual_seed(0)
    loss = make_loss()
    encoder = extract_network(loss, "task_encoder")
    contexts = [point_mass(GOALS, 48, seed=seed) for seed in (1000, 1001)]
    before = nearness(*(embed_context(encoder, context) for context in contexts))
    train(loss, 600, "encoder")
    encoder = extract_network(loss, "task_encoder")
    assert nearness(*(embed_context(encoder, context) for context in contexts)) < 0.5 * before


def test_the_actor_moves_to_the_goal_of_a_context_of_a_task_it_was_not_trained_on() -> None:
    torch.manual_seed(0)
    loss = make_loss()
    train(loss, 1000, "encoder")
    train(loss, 250, "divergence", "qvalue", "actor")
    context = point_mass(HELD_OUT, 32, seed=1000)
    latent = embed_context(extract_network(loss, "task_encoder"), context)
    state = TensorDict({"observation": torch.zeros(4, 2), "task_latent": latent}, [4])
    action = extract_network(loss, "actor_network")(state)["action"]
    direction = torch.as_tensor(HELD_OUT, dtype=torch.float32)
    assert (torch.cosine_similarity(action, direction) > 0.6).all()
