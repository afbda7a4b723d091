"""The library's generators beside the autoencoder: a flow and a mixture."""

from __future__ import annotations

import math
import shutil
from functools import partial
from typing import Any

import pytest
import torch
from helpers import BOUNDS, CRITICS, DIMS, NO_UPDATER, OBSERVATION_DIM, Q, make_critics, transitions
from tensordict import TensorDict
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import bcq_next_value
from torchrl_bmrl.generators import ActionKeys
from torchrl_bmrl.modules import (
    ActionFlow,
    ActionMixture,
    BCQPolicy,
    make_decoder,
    make_latent_actor,
    make_qvalue_network,
    make_task_classifier,
    make_task_encoder,
)
from torchrl_bmrl.objectives import BCQLoss, MetaDistillationLoss, PLASLoss, StackedLoss
from torchrl_bmrl.testing import Case, OfflineLossContract
from torchrl_bmrl.testing.contract.compiled import check_compiled

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GENERATORS = {"flow": ActionFlow, "mixture": ActionMixture}
each = pytest.mark.parametrize("make", GENERATORS.values(), ids=GENERATORS)


def networks(make: Any) -> dict[str, Any]:
    return {"generator": make(*DIMS, num_cells=(8,)), Q: make_critics(1)[0]}


def case_of(make: Any) -> Case:
    return Case(BCQLoss, partial(networks, make), CRITICS, (Q,), BOUNDS)


class _Contract(OfflineLossContract):
    """All of the contract, but for what renames or shares the parts of an autoencoder."""

    test_renamed_and_nested_keys_give_the_same_losses = None
    test_separate_losses_leave_a_shared_torso_to_the_generator = None
    test_shared_parameters_are_trained_once_for_all = None


class TestBCQOverAnActionFlow(_Contract):
    case = case_of(ActionFlow)


class TestBCQOverAnActionMixture(_Contract):
    case = case_of(ActionMixture)


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no compiler")
@each
def test_inductor_gives_the_same_values(make: Any) -> None:
    with torch._inductor.config.patch(fallback_random=True):
        check_compiled(case_of(make))


def train(generator: Any, data: TensorDict, updates: int = 400) -> None:
    optimizer = torch.optim.Adam(generator.parameters(), lr=3e-3)
    for _ in range(updates):
        loss, _ = generator.row_loss(data, ActionKeys())
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()


def two_modes(low: float, high: float) -> TensorDict:
    """Actions at a quarter and three quarters of the range, whatever the state is."""
    side = torch.randint(2, (512, 1)) * 0.5 + 0.25
    action = low + (high - low) * (side + 0.02 * torch.randn(512, 1))
    return TensorDict({"observation": torch.randn(512, 1), "action": action}, [512])


@each
def test_proposals_have_both_modes_of_the_data_in_the_actions_own_units(make: Any) -> None:
    torch.manual_seed(0)
    low, high = 10.0, 30.0
    generator, data = make(1, 1, bounds=(low, high), num_cells=(64, 64)), two_modes(low, high)
    train(generator, data)
    with torch.no_grad():
        action = generator.propose(data[:1], 400, ActionKeys())["action"].flatten()
    near = torch.minimum((action - 15.0).abs(), (action - 25.0).abs()) < 2.0
    assert near.double().mean() > 0.8
    assert 0.3 < (action > 20.0).double().mean() < 0.7


@each
def test_actions_lie_within_the_bounds_and_depend_on_the_latent_alone(make: Any) -> None:
    generator = make(*DIMS, bounds=(-2.0, 0.5))
    state = TensorDict({"observation": torch.randn(5, OBSERVATION_DIM)}, [5])
    latent = 10.0 * torch.randn(5, generator.latent_dim)
    first, second = (
        generator.decode(state.copy().set("action_latent", latent), ActionKeys())["action"]
        for _ in range(2)
    )
    assert torch.equal(first, second)
    assert first.min() >= -2.0
    assert first.max() <= 0.5
    assert (first == -2.0).any()
    assert (first == 0.5).any()


@each
def test_a_dimension_with_equal_bounds_is_constant_and_disturbs_no_other(make: Any) -> None:
    low, high = torch.tensor([-1.0, 0.3]), torch.tensor([1.0, 0.3])
    generator = make(1, 2, bounds=(low, high), num_cells=(8,))
    action = torch.stack([torch.linspace(-1.0, 1.0, 8), torch.full((8,), 0.3)], -1)
    data = TensorDict({"observation": torch.randn(8, 1), "action": action}, [8])
    loss, _ = generator.row_loss(data, ActionKeys())
    loss.mean().backward()
    assert loss.isfinite().all()
    assert all(p.grad.isfinite().all() for p in generator.parameters())
    proposed = generator.propose(data.select("observation"), 5, ActionKeys())["action"]
    assert (proposed[..., 1] == low[1]).all()
    assert proposed[..., 0].std() > 0


@each
def test_candidates_are_decoded_as_single_actions_are(make: Any) -> None:
    generator = make(*DIMS)
    state = TensorDict({"observation": torch.randn(6, OBSERVATION_DIM)}, [6])
    proposed = generator.propose(state, 5, ActionKeys())
    alone = TensorDict(
        {key: proposed[key].contiguous() for key in ("observation", "action_latent")}, [6, 5]
    )
    torch.testing.assert_close(generator.decode(alone, ActionKeys())["action"], proposed["action"])


def test_the_flow_takes_as_many_steps_as_it_names_and_its_decoder_integrates_the_velocity() -> None:
    flow = ActionFlow(*DIMS, euler_steps=3)
    calls = []
    flow.decoder.module.velocity.register_forward_hook(lambda *x: calls.append(x[1][2].flatten()))
    state, z = torch.randn(2, OBSERVATION_DIM), torch.zeros(2, flow.latent_dim)
    flow.decoder(TensorDict({"observation": state, "action_latent": z}, [2]))
    assert [round(x[0].item(), 4) for x in calls] == [0.0, 0.3333, 0.6667]


def test_a_straight_velocity_carries_the_latent_to_the_action_in_any_number_of_steps() -> None:
    for steps in (1, 2, 7):
        flow = ActionFlow(1, 2, euler_steps=steps, num_cells=())
        velocity = flow.decoder.module.velocity[0]
        with torch.no_grad():
            velocity.weight.zero_()
            velocity.bias.copy_(torch.tensor([0.25, -0.5]))
        z = torch.tensor([[0.1, 0.2]])
        data = TensorDict({"observation": torch.zeros(1, 1), "action_latent": z}, [1])
        torch.testing.assert_close(flow.decoder(data)["action"], torch.tensor([[0.35, -0.3]]))


def test_the_mixture_s_loss_is_torch_s_negative_log_likelihood_per_dimension() -> None:
    mixture, data = ActionMixture(*DIMS, num_components=3), transitions(8).float()
    log_weight, loc, scale = mixture.decoder.module.components(data["observation"])
    parts = Independent(Normal(loc, scale), 1)
    density = MixtureSameFamily(Categorical(logits=log_weight), parts)
    expected = -density.log_prob(data["action"]) / DIMS[1]
    loss, metrics = mixture.row_loss(data, ActionKeys())
    torch.testing.assert_close(loss, expected)
    assert metrics["negative_log_likelihood"] is loss


def test_the_mixture_s_draws_have_its_means_deviations_and_weights() -> None:
    torch.manual_seed(0)
    mixture = ActionMixture(1, 1, num_components=2, min_scale=0.01, num_cells=())
    layer = mixture.decoder.module.network[0]
    with torch.no_grad():
        layer.weight.zero_()
        # logits, then mean and raw scale of each component: softplus(-3) = 0.0486
        layer.bias.copy_(torch.tensor([math.log(3.0), 0.0, -0.5, -3.0, 0.5, -3.0]))
    state = TensorDict({"observation": torch.zeros(1, 1)}, [1])
    action = mixture.propose(state, 20_000, ActionKeys())["action"].flatten()
    left = action[action < 0]
    assert len(left) / len(action) == pytest.approx(0.75, abs=0.01)
    assert left.mean().item() == pytest.approx(-0.5, abs=0.005)
    assert left.std().item() == pytest.approx(0.0586, abs=0.003)


def test_the_mixture_runs_its_network_once_for_all_candidates() -> None:
    mixture, rows = ActionMixture(*DIMS), []
    mixture.decoder.module.network.register_forward_hook(lambda *x: rows.append(x[1][0].shape))
    state = TensorDict({"observation": torch.randn(4, OBSERVATION_DIM)}, [4])
    mixture.propose(state, 100, ActionKeys())
    assert [shape.numel() // OBSERVATION_DIM for shape in rows] == [4]


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (ActionFlow, {"euler_steps": 0}, "euler_steps is 0; valid: at least 1"),
        (ActionMixture, {"num_components": 0}, "num_components is 0; valid: at least 1"),
        (ActionMixture, {"min_scale": 0.0}, "min_scale is 0.0; valid: above 0"),
    ],
)
def test_options_that_make_no_model_are_refused(make: Any, options: Any, message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        make(*DIMS, **options)


@each
def test_bcq_over_them_takes_no_option_of_an_autoencoder_and_draws_unclipped_latents(
    make: Any,
) -> None:
    loss = BCQLoss(make(*DIMS), make_critics(2), **BOUNDS)
    assert loss.latent_clip is None
    assert BCQPolicy.frozen(loss).latent_clip is None
    for option in ({"kl_weight": 0.1}, {"latent_clip": 1.0}):
        with pytest.raises(BMRLError, match=f"{next(iter(option))} is .* does not take it"):
            BCQLoss(make(*DIMS), make_critics(2), **BOUNDS, **option)


@each
def test_a_policy_over_them_has_no_bound_on_the_latent_and_refuses_one(make: Any) -> None:
    assert BCQPolicy(make(*DIMS), make_critics(1)[0]).latent_clip is None  # as it acts
    with pytest.raises(BMRLError, match=r"latent_clip is 0\.3, and generator .*; valid: None"):
        BCQPolicy(make(*DIMS), make_critics(1)[0], latent_clip=0.3)


@each
def test_policies_of_the_loss_and_of_the_decoder_choose_the_same_actions(make: Any) -> None:
    loss = BCQLoss(make(*DIMS).double(), make_critics(2), **BOUNDS)
    state = TensorDict({"observation": torch.randn(6, OBSERVATION_DIM).double()}, [6])
    policy = BCQPolicy.live(loss, num_candidates=4)
    torch.manual_seed(0)
    proposals = loss.propose(state, 4)
    best = loss.qvalue(proposals)[0].argmax(-1)
    torch.manual_seed(0)
    chosen = policy(state)["action"]
    torch.testing.assert_close(chosen, proposals["action"][torch.arange(6), best])


@each
@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_stacked_members_have_their_own_losses(make: Any, deactivate_vmap: bool) -> None:
    case = case_of(make)
    alone = [case.make(seed=seed) for seed in range(2)]
    stack = StackedLoss(
        [case.make(seed=seed) for seed in range(2)], deactivate_vmap=deactivate_vmap
    )
    data = torch.stack([transitions(8, seed=seed) for seed in range(2)])
    if deactivate_vmap:  # the same draws, one member after the other
        torch.manual_seed(0)
        value, _ = stack.generator_loss(data)
        torch.manual_seed(0)
        expected = [loss.generator_loss(data[i])[0] for i, loss in enumerate(alone)]
        torch.testing.assert_close(value, torch.stack(expected))
    losses = stack(data)
    (losses["loss_generator"] + losses["loss_qvalue"]).sum().backward()
    for gradient in (p.grad for p in stack.generator_params.parameters()):
        assert gradient.flatten(1).abs().sum(1).gt(0).all()


@each
def test_plas_learns_a_policy_in_their_latent(make: Any) -> None:
    generator = make(*DIMS).double()
    actor = make_latent_actor(OBSERVATION_DIM, generator.latent_dim).double()
    loss = PLASLoss(generator, actor, make_critics(2), **BOUNDS)
    losses = loss(transitions(8))
    losses["loss_actor"].backward()
    assert any(p.grad.abs().sum() > 0 for p in loss.actor_network_params.parameters())


@each
def test_a_student_distils_their_map_in_one_call(make: Any) -> None:
    """After training, the student's action is the teacher's for the same latent."""
    torch.manual_seed(0)
    teacher, critic = make(1, 1, num_cells=(16,)), make_qvalue_network(1, 1)
    student = make_decoder(1, 1, teacher.latent_dim, task_latent_dim=2, num_cells=(64, 64))
    loss = MetaDistillationLoss(
        make_task_encoder(1, 1, 2),
        make_task_classifier(1, 2),
        student,
        make_qvalue_network(1, 1, task_latent_dim=2),
        [teacher.decoder],
        [critic],
        latent_dim=teacher.latent_dim,
        latent_clip=None,
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    after = {"observation": torch.randn(1, 256, 1), "reward": torch.randn(1, 256, 1)}
    data = {"observation": torch.randn(1, 256, 1), "action": torch.rand(1, 256, 1)}
    data |= {"task": torch.zeros(1, 256, dtype=torch.int64), "next": after}
    batch = TensorDict(data, [1, 256])
    errors = []
    for _ in range(200):
        losses = loss(batch)
        errors.append(losses["loss_generator"].item())
        total = sum(value for key, value in losses.items() if key.startswith("loss_"))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert errors[-1] < 0.25 * errors[0]


@each
def test_the_backup_is_the_best_of_their_candidates(make: Any) -> None:
    loss = BCQLoss(make(*DIMS).double(), make_critics(2), **BOUNDS, num_candidates=4)
    data = transitions(8)
    torch.manual_seed(0)
    _, metrics = loss.qvalue_loss(data)
    torch.manual_seed(0)
    values = loss.qvalue(loss.propose(data["next"].select("observation"), 4), target=True)
    expected = bcq_next_value(values, 0.75).mean()
    torch.testing.assert_close(metrics["next_state_value"], expected)
