"""BCQLoss: its numbers, where its gradients go, and TorchRL's contract."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    CELLS,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    as_keywords,
    make_bcq_loss,
    numpy_decoder,
    numpy_mlp,
    recorded,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import HardUpdate, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import ActionVAE, make_perturbation_network, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GAMMA, LMBDA, CANDIDATES = 0.5, 0.75, 6  # 0.5 is exact in float32, which TorchRL keeps gamma in


def network_names(loss: BCQLoss) -> set[str]:
    """Networks that hold a gradient other than zero."""
    return {
        name.split(".")[0]
        for name, parameter in loss.named_parameters()
        if parameter.grad is not None and parameter.grad.any()
    }


def state(loss: BCQLoss) -> dict[str, Tensor]:
    return {key: value.clone() for key, value in loss.state_dict().items()}


def equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def total(losses: TensorDict) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def expected_next_value(loss: BCQLoss, latent: Tensor, data: TensorDict) -> np.ndarray:
    """Value of the next states for given latents ``(*B, candidates, latent_dim)``, in numpy."""
    observation = data["next", "observation"].numpy()[..., None, :]
    observation = np.broadcast_to(observation, (*latent.shape[:-1], OBSERVATION_DIM))
    action = numpy_decoder(loss.generator_params["decoder"], observation, latent)
    if loss.perturbation_network is not None:
        network = loss.target_perturbation_network_params["module", "network"]
        moved = action + 0.4 * np.tanh(numpy_mlp(network, observation, action))
        action = np.clip(moved, -0.25, 0.25)
    targets = loss.target_qvalue_network_params["module"]
    q = np.stack([numpy_mlp(targets[j], observation, action)[..., 0] for j in (0, 1)])
    return (LMBDA * q.min(0) + (1 - LMBDA) * q.max(0)).max(-1)


# -- the critics' target -----------------------------------------------------------------------


@pytest.mark.parametrize("perturbation", [False, True])
@pytest.mark.parametrize("batch", [(8,), (2, 4)])
def test_qvalue_loss_is_that_of_the_equations(perturbation: bool, batch: tuple[int, ...]) -> None:
    options = {"max_perturbation": 0.4, "bounds": (-0.25, 0.25)} if perturbation else {}
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


def test_truncated_transitions_bootstrap_and_terminated_ones_do_not() -> None:
    loss = make_bcq_loss(gamma=GAMMA, reduction="none")
    for parameter in loss.qvalue_network_params.values(True, True):
        parameter.data.zero_()  # prediction 0: the loss is twice the squared target
    data = transitions(4)
    data["next", "reward"].zero_()
    loss.target_qvalue_network_params["module", "2", "bias"].data.add_(10.0)
    bootstrapped = loss.qvalue_loss(data)[0] > 1.0
    assert data["next", "done"].squeeze(-1).tolist() == [True, True, False, False]
    assert bootstrapped.tolist() == [False, True, True, True]


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
    )
    proposed = recorded(loss.generator.decoder.module)
    perturbations = recorded(loss.perturbation_network.module)
    judged = recorded(loss.qvalue_network.module)
    loss.qvalue_loss(transitions(8))
    action, perturbation = proposed[0][1], perturbations[0][1]
    seen = judged[0][0][1]
    assert perturbation.shape == seen.shape == (8, 10, ACTION_DIM)
    assert (perturbation[..., 0] != perturbation[..., 1]).all()
    moved = action + 0.4 * perturbation
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


def test_perturbation_loss_is_minus_the_first_critic_at_the_perturbed_proposal() -> None:
    loss = make_bcq_loss(perturbation=True, max_perturbation=0.4, bounds=(-0.25, 0.25))
    data = transitions(8)
    calls = recorded(loss.generator.decoder.module)
    value, _ = loss.perturbation_loss(data)
    (observation, latent), _ = calls[0]
    assert torch.equal(observation, data["observation"])
    action = numpy_decoder(loss.generator_params["decoder"], observation, latent)
    network = loss.perturbation_network_params["module", "network"]
    action = np.clip(action + 0.4 * np.tanh(numpy_mlp(network, observation, action)), -0.25, 0.25)
    q = numpy_mlp(loss.qvalue_network_params["module"][0], observation, action)
    np.testing.assert_allclose(value.item(), -q.mean(), rtol=1e-10)


def test_perturbation_loss_without_a_network_is_refused() -> None:
    with pytest.raises(BMRLError, match="without a perturbation_network"):
        make_bcq_loss().perturbation_loss(transitions(8))


# -- gradients and targets ---------------------------------------------------------------------


@pytest.mark.parametrize("through", ["method", "forward"])
@pytest.mark.parametrize(
    ("name", "network"),
    [
        ("generator", "generator_params"),
        ("qvalue", "qvalue_network_params"),
        ("perturbation", "perturbation_network_params"),
    ],
)
def test_a_loss_sends_gradients_to_its_own_network_alone(
    through: str, name: str, network: str
) -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(8)
    if through == "method":
        value = getattr(loss, f"{name}_loss")(data)[0]
    else:
        value = loss(data)[f"loss_{name}"]
    value.backward()
    assert network_names(loss) == {network}
    own = [p for key, p in loss.named_parameters() if key.startswith(f"{network}.")]
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in own)


def test_outputs_that_are_no_losses_are_detached() -> None:
    for key, value in make_bcq_loss(perturbation=True)(transitions(8)).items():
        assert value.requires_grad == key.startswith("loss_")


def test_an_optimizer_leaves_the_targets_to_the_updater() -> None:
    loss = make_bcq_loss(perturbation=True)
    SoftUpdate(loss, tau=0.1)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    before = state(loss)
    total(loss(transitions(8))).backward()
    optimizer.step()
    after = state(loss)
    moved = {key.split(".")[0] for key in before if not torch.equal(before[key], after[key])}
    assert moved == {"generator_params", "qvalue_network_params", "perturbation_network_params"}


def test_soft_update_moves_the_targets_by_tau() -> None:
    loss = make_bcq_loss(perturbation=True)
    updater = SoftUpdate(loss, tau=0.1)
    for parameter in loss.parameters():
        parameter.data.add_(1.0)
    before = state(loss)
    updater.step()
    after = state(loss)
    changed = 0
    for key in before:
        if key.startswith("target_"):
            expected = 0.9 * before[key] + 0.1 * before[key.removeprefix("target_")]
            torch.testing.assert_close(after[key], expected)
            changed += not torch.equal(after[key], before[key])
        else:
            assert torch.equal(after[key], before[key])
    assert changed == 2 * 4  # weights and biases of two layers, critics and perturbation


def test_hard_update_copies_the_networks_at_its_interval() -> None:
    loss = make_bcq_loss()
    updater = HardUpdate(loss, value_network_update_interval=1)
    for parameter in loss.parameters():
        parameter.data.add_(1.0)
    params = loss.qvalue_network_params
    updater.step()
    assert not (loss.target_qvalue_network_params == params).all()
    updater.step()
    assert (loss.target_qvalue_network_params == params).all()


def test_critics_keep_the_initialisations_that_they_came_with() -> None:
    torch.manual_seed(0)
    critics = [make_qvalue_network(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS) for _ in range(3)]
    weights = [critic.module[0].weight.detach().clone() for critic in critics]
    loss = BCQLoss(
        ActionVAE(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS), critics, bounds=(-1.0, 1.0)
    )
    stacked = loss.qvalue_network_params["module", "0", "weight"]
    assert torch.equal(stacked, torch.stack(weights))
    assert torch.equal(loss.target_qvalue_network_params["module", "0", "weight"], stacked)
    assert not torch.equal(stacked[0], stacked[1])


# -- TorchRL's contract ------------------------------------------------------------------------


def test_forward_writes_the_priority_and_leaves_the_rest_of_the_input() -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(2, 4)
    before = data.clone()
    torch.manual_seed(0)
    loss(data)
    priority = data.pop("td_error")
    assert set(data.keys(True)) == set(before.keys(True))
    assert (data == before).all()
    torch.manual_seed(0)
    loss.generator_loss(data)
    _, info = loss.qvalue_loss(data)
    assert priority.shape == (2, 4)
    assert torch.equal(priority, info["td_error"].amax(0))


@pytest.mark.parametrize("name", ["generator", "qvalue", "perturbation"])
def test_loss_methods_leave_the_input(name: str) -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(8)
    before = data.clone()
    getattr(loss, f"{name}_loss")(data)
    assert set(data.keys(True)) == set(before.keys(True))
    assert (data == before).all()


def test_forward_is_the_methods_in_update_order() -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(8)
    torch.manual_seed(0)
    whole = loss(data)
    torch.manual_seed(0)
    parts = [
        getattr(loss, f"{name}_loss")(data)[0] for name in ("generator", "qvalue", "perturbation")
    ]
    assert [whole[f"loss_{n}"].item() for n in ("generator", "qvalue", "perturbation")] == [
        part.item() for part in parts
    ]


@pytest.mark.parametrize("perturbation", [False, True])
def test_keyword_dispatch_returns_the_out_keys_in_order(perturbation: bool) -> None:
    loss = make_bcq_loss(perturbation=perturbation)
    data = transitions(8)
    torch.manual_seed(0)
    expected = loss(data)
    assert set(expected.keys()) == set(loss.out_keys)
    torch.manual_seed(0)
    result = loss(**as_keywords(data, loss.in_keys))
    assert len(result) == len(loss.out_keys) == (8 if perturbation else 7)
    for key, value in zip(loss.out_keys, result, strict=True):
        assert torch.equal(value, expected[key]), key


def test_only_the_in_keys_are_read() -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(8)
    torch.manual_seed(0)
    expected = loss(data.clone())
    torch.manual_seed(0)
    assert (loss(data.select(*loss.in_keys)) == expected).all()
    # TorchRL's estimators do without "done", or take it for a "terminated" that is missing.
    for key in set(loss.in_keys) - {("next", "done"), ("next", "terminated")}:
        with pytest.raises((KeyError, AttributeError)):
            loss(data.exclude(key))


def test_select_out_keys_keeps_only_those() -> None:
    loss = make_bcq_loss()
    loss.select_out_keys("loss_qvalue")
    assert list(loss(transitions(8)).keys()) == ["loss_qvalue"]
    result = loss(**as_keywords(transitions(8), loss.in_keys))
    assert isinstance(result, Tensor)


def test_renamed_and_nested_keys_give_the_same_losses() -> None:
    dims = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM, "num_cells": CELLS}
    names = {
        "observation": ("agent", "observation"),
        "action": ("agent", "action"),
        "state_action_value": ("agent", "q"),
        "perturbation": "xi",
        "action_latent": ("agent", "z"),
        "action_latent_loc": ("agent", "mu"),
        "action_latent_scale": ("agent", "sigma"),
    }

    def renamed(module: TensorDictModule) -> TensorDictModule:
        return TensorDictModule(
            module.module,
            in_keys=[names.get(key, key) for key in module.in_keys],
            out_keys=[names[key] for key in module.out_keys],
        )

    def build(rename: Callable[[TensorDictModule], TensorDictModule]) -> BCQLoss:
        torch.manual_seed(0)
        generator = ActionVAE(**dims)
        generator.encoder = rename(generator.encoder)
        generator.decoder = rename(generator.decoder)
        critics = [rename(make_qvalue_network(**dims)) for _ in range(2)]
        perturbation = rename(make_perturbation_network(**dims))
        return BCQLoss(generator, critics, perturbation, bounds=(-1.0, 1.0), gamma=GAMMA)

    plain, other = build(lambda module: module), build(renamed)
    keys = {
        **{name: key for name, key in names.items() if name != "observation"},
        "reward": ("agent", "reward"),
        "done": "over",
        "terminated": "dead",
        "priority": ("agent", "priority"),
        "priority_weight": "importance",
    }
    other.set_keys(**keys)
    data = transitions(8, dtype=torch.float32)
    data["priority_weight"] = torch.rand(8)
    renamed_data = TensorDict(
        {
            "agent": {"observation": data["observation"], "action": data["action"]},
            "importance": data["priority_weight"],
            "next": {
                "agent": {
                    "observation": data["next", "observation"],
                    "reward": data["next", "reward"],
                },
                "over": data["next", "done"],
                "dead": data["next", "terminated"],
            },
        },
        batch_size=[8],
    )
    assert other.in_keys == [
        ("agent", "observation"),
        ("agent", "action"),
        ("next", "agent", "observation"),
        ("next", "agent", "reward"),
        ("next", "over"),
        ("next", "dead"),
    ]
    torch.manual_seed(1)
    expected = plain(data)
    torch.manual_seed(1)
    result = other(renamed_data)
    assert (result == expected).all()
    assert torch.equal(renamed_data["agent", "priority"], data["td_error"])
    other.set_keys(reward=None)
    assert ("next", "reward") in other.in_keys


def test_an_unknown_key_name_is_refused_with_the_accepted_ones() -> None:
    with pytest.raises(ValueError, match=r"goal is not an accepted tensordict key.*priority"):
        make_bcq_loss().set_keys(goal="g")


@pytest.mark.parametrize("name", ["generator", "qvalue", "perturbation"])
@pytest.mark.parametrize("batch", [(8,), (2, 4)])
def test_reductions_agree(name: str, batch: tuple[int, ...]) -> None:
    loss = make_bcq_loss(perturbation=True)
    values = {}
    for reduction in ("none", "sum", "mean"):
        loss.reduction = reduction
        torch.manual_seed(0)
        values[reduction] = getattr(loss, f"{name}_loss")(transitions(*batch))[0]
    assert values["none"].shape == batch
    torch.testing.assert_close(values["sum"], values["none"].sum())
    torch.testing.assert_close(values["mean"], values["none"].mean())


@pytest.mark.parametrize("name", ["generator", "qvalue", "perturbation"])
@pytest.mark.parametrize("mask_key", [("collector", "mask"), "valid"])
def test_masked_rows_do_not_count(name: str, mask_key: Any) -> None:
    loss = make_bcq_loss(perturbation=True)
    data = transitions(8)
    torch.manual_seed(0)
    loss.reduction = "none"
    rows = getattr(loss, f"{name}_loss")(data)[0]
    loss.reduction = "mean"
    mask = torch.arange(8) % 3 > 0
    data[mask_key] = mask.unsqueeze(-1)
    if mask_key == "valid":
        loss.loss_mask_key = mask_key
    torch.manual_seed(0)
    value = getattr(loss, f"{name}_loss")(data)[0]
    torch.testing.assert_close(value, rows[mask].mean())


@pytest.mark.parametrize("name", ["generator", "qvalue", "perturbation"])
@pytest.mark.parametrize("use", ["auto", True, False])
def test_priority_weights_weigh_the_rows(name: str, use: str | bool) -> None:
    loss = make_bcq_loss(perturbation=True, use_prioritized_weights=use)
    data = transitions(8)
    torch.manual_seed(0)
    loss.reduction = "none"
    rows = getattr(loss, f"{name}_loss")(data)[0]
    loss.reduction = "mean"
    weight = torch.linspace(0.1, 1.0, 8, dtype=torch.float64)
    data["priority_weight"] = weight
    torch.manual_seed(0)
    value = getattr(loss, f"{name}_loss")(data)[0]
    expected = rows.mean() if use is False else (rows * weight).sum() / weight.sum()
    torch.testing.assert_close(value, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_losses_have_the_dtype_of_networks_and_data(dtype: torch.dtype) -> None:
    loss = make_bcq_loss(perturbation=True, dtype=dtype)
    losses = loss(transitions(8, dtype=dtype))
    assert {value.dtype for value in losses.values()} == {dtype}
    total(losses).backward()
    assert {parameter.grad.dtype for parameter in loss.parameters()} == {dtype}


@pytest.mark.parametrize("batch", [(8,), (2, 4)])
def test_vmap_and_loop_over_critics_agree(batch: tuple[int, ...]) -> None:
    results, gradients = [], []
    for deactivate_vmap in (False, True):
        loss = make_bcq_loss(perturbation=True, deactivate_vmap=deactivate_vmap)
        calls = recorded(loss.qvalue_network.module)
        loss.qvalue_loss(transitions(*batch))
        assert len(calls) == (4 if deactivate_vmap else 2)  # targets and predictions
        torch.manual_seed(0)
        results.append(loss(transitions(*batch)))
        total(results[-1]).backward()
        gradients.append([parameter.grad for parameter in loss.parameters()])
    torch.testing.assert_close(results[0].to_dict(), results[1].to_dict())
    torch.testing.assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize("num_critics", [1, 3])
def test_any_number_of_critics_works(num_critics: int) -> None:
    loss = make_bcq_loss(num_critics=num_critics)
    assert loss.qvalue_loss(transitions(8))[1]["td_error"].shape == (num_critics, 8)


def test_state_dict_is_the_same_before_and_after_use_and_loads_strictly() -> None:
    loss, other = make_bcq_loss(perturbation=True), make_bcq_loss(perturbation=True, seed=1)
    before = state(loss)
    SoftUpdate(loss, tau=0.1).step()
    used = other(transitions(8))
    total(used).backward()
    assert other.state_dict().keys() == before.keys()
    other.load_state_dict(before, strict=True)
    assert equal(state(other), before)
    fresh = make_bcq_loss(perturbation=True, seed=2)
    fresh.load_state_dict(other.state_dict(), strict=True)
    results = []
    for module in (fresh, other):
        torch.manual_seed(0)
        results.append(module(transitions(8)))
    assert (results[0] == results[1]).all()
    assert not torch.equal(used["loss_qvalue"], results[0]["loss_qvalue"])


def test_a_deep_copy_gives_the_same_losses_and_is_independent() -> None:
    loss = make_bcq_loss(perturbation=True)
    copy = deepcopy(loss)
    results = []
    for module in (loss, copy):
        torch.manual_seed(0)
        results.append(module(transitions(8)))
    assert (results[0] == results[1]).all()
    before = state(loss)
    total(copy(transitions(8))).backward()
    torch.optim.SGD(copy.parameters(), lr=1.0).step()
    assert equal(state(loss), before)
    assert not equal(state(copy), before)
    assert all(parameter.grad is None for parameter in loss.parameters())


# -- value estimators --------------------------------------------------------------------------


def lambda_return(
    reward: np.ndarray,
    value: np.ndarray,
    done: np.ndarray,
    terminated: np.ndarray,
    lmbda: float,
) -> np.ndarray:
    """Backward recursion over the last dimension; an episode's end takes the bootstrap alone."""
    result = np.zeros_like(reward)
    after = value[:, -1]
    for t in reversed(range(reward.shape[1])):
        mixed = (1 - lmbda) * value[:, t] + lmbda * after
        bootstrap = np.where(done[:, t], value[:, t], mixed)
        result[:, t] = after = reward[:, t] + GAMMA * (1 - terminated[:, t]) * bootstrap
    return result


@pytest.mark.parametrize(
    ("estimator", "lmbda"), [(ValueEstimators.TD1, 1.0), (ValueEstimators.TDLambda, 0.8)]
)
def test_multi_step_targets_go_back_over_the_time_dimension(
    estimator: ValueEstimators, lmbda: float
) -> None:
    loss = make_bcq_loss(num_candidates=CANDIDATES, lmbda=LMBDA)
    options = {"lmbda": lmbda} if estimator is ValueEstimators.TDLambda else {}
    assert loss.make_value_estimator(estimator, gamma=GAMMA, **options) is loss
    data = transitions(3, 5)  # (episodes, time): terminated at step 0, truncated at step 1
    calls = recorded(loss.generator.decoder.module)
    _, info = loss.qvalue_loss(data)
    target = lambda_return(
        data["next", "reward"].squeeze(-1).numpy(),
        expected_next_value(loss, calls[0][0][1], data),
        data["next", "done"].squeeze(-1).numpy(),
        data["next", "terminated"].squeeze(-1).numpy(),
        lmbda,
    )
    critics = loss.qvalue_network_params["module"]
    predicted = np.stack(
        [numpy_mlp(critics[j], data["observation"], data["action"])[..., 0] for j in (0, 1)]
    )
    np.testing.assert_allclose(info["td_error"], (predicted - target) ** 2, rtol=1e-6)


@pytest.mark.parametrize(
    "user",
    [
        (TD0Estimator, {"gamma": GAMMA, "value_network": None}),
        (TD0Estimator(gamma=GAMMA, value_network=None), {}),
    ],
)
def test_an_estimator_of_the_user_gives_the_default_target(user: tuple[Any, dict]) -> None:
    expected, loss = make_bcq_loss(gamma=GAMMA), make_bcq_loss(gamma=0.1)
    estimator, options = user
    assert loss.make_value_estimator(estimator, **options) is loss
    results = []
    for module in (expected, loss):
        torch.manual_seed(0)
        results.append(module.qvalue_loss(transitions(8))[1]["target_value"])
    assert torch.equal(*results)


def test_an_estimator_of_the_user_reads_the_renamed_keys() -> None:
    loss = make_bcq_loss()
    loss.set_keys(reward="prize")
    loss.make_value_estimator(TDLambdaEstimator(gamma=GAMMA, lmbda=0.8, value_network=None))
    assert loss.value_estimator.tensor_keys.reward == "prize"
    loss.set_keys(reward="score")
    assert loss.value_estimator.tensor_keys.reward == "score"


def test_estimators_that_make_no_sense_are_refused_with_the_valid_ones() -> None:
    with pytest.raises(NotImplementedError, match=r"TD0.*TD1.*TDLambda"):
        make_bcq_loss().make_value_estimator(ValueEstimators.GAE)


# -- arguments ---------------------------------------------------------------------------------

SPEC = Bounded(low=torch.tensor([-1.0, -2.0]), high=torch.tensor([0.5, 3.0]), shape=(2,))


@pytest.mark.parametrize("spec", [SPEC, Composite(action=SPEC)])
def test_bounds_may_come_from_the_action_spec(spec: Any) -> None:
    loss = make_bcq_loss(bounds=None, action_spec=spec)
    assert loss.action_low.tolist() == [-1.0, -2.0]
    assert loss.action_high.tolist() == [0.5, 3.0]
    assert {"action_low", "action_high"} <= loss.state_dict().keys()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_candidates": 0}, "num_candidates is 0; valid: at least 1"),
        ({"lmbda": 1.5}, "lmbda is 1.5; valid: between 0 and 1"),
        ({"lmbda": -0.1}, "lmbda is -0.1; valid: between 0 and 1"),
        ({"loss_function": "huber"}, "'huber'; valid .*: l2, l1, smooth_l1"),
        ({"reduction": "avg"}, "'avg'; valid .*: mean, sum, none"),
        ({"bounds": None}, "either action_spec or bounds; got neither"),
        ({"action_spec": SPEC}, "either action_spec or bounds; got both"),
        ({"bounds": (1.0, -1.0)}, "lower bound .* above the upper"),
        ({"bounds": None, "action_spec": Unbounded((2,))}, "valid: Bounded"),
    ],
)
def test_bad_options_are_refused_with_the_valid_values(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(BMRLError, match=message):
        make_bcq_loss(**options)


@pytest.mark.parametrize("part", ["encoder", "decoder", "latent_dim"])
def test_a_generator_that_lacks_a_part_is_refused_by_name(part: str) -> None:
    generator = ActionVAE(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS)
    delattr(generator, part)
    critic = make_qvalue_network(OBSERVATION_DIM, ACTION_DIM)
    with pytest.raises(BMRLError, match=f"no '{part}'; valid:"):
        BCQLoss(generator, [critic], bounds=(-1.0, 1.0))


@pytest.mark.parametrize("critics", [[], make_qvalue_network(OBSERVATION_DIM, ACTION_DIM)])
def test_critics_that_are_no_list_are_refused(critics: Any) -> None:
    generator = ActionVAE(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS)
    with pytest.raises(BMRLError, match="valid: a list of critics"):
        BCQLoss(generator, critics, bounds=(-1.0, 1.0))


def test_training_lowers_the_losses_on_one_batch() -> None:
    loss = make_bcq_loss(perturbation=True, dtype=torch.float32)
    updater = SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    data = transitions(16, dtype=torch.float32)
    history = []
    for _ in range(100):
        losses = loss(data)
        optimizer.zero_grad()
        total(losses).backward()
        optimizer.step()
        updater.step()
        history.append(losses.detach())
    assert history[-1]["loss_qvalue"] < 0.3 * history[0]["loss_qvalue"]
    assert history[-1]["loss_generator"] < 0.6 * history[0]["loss_generator"]
