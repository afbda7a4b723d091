"""Unusual options, networks and data that are valid are accepted and used."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    CRITIC_KEYS,
    DIMS,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    discrete_transitions,
    make_bcq_loss,
    make_critics,
    make_discrete_bcq_loss,
    make_distillation_loss,
    make_plas_loss,
    refused,
    run,
    task_transitions,
    total,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical, Composite, OneHot
from torchrl.modules import MLP
from torchrl.objectives import SoftUpdate, ValueEstimators

from torchrl_bmrl.modules import ActionVAE, DiscreteBCQPolicy
from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, OfflineLoss, PLASLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [make_bcq_loss, make_plas_loss, make_discrete_bcq_loss, make_distillation_loss],
)
def test_no_reduction_is_the_mean(make: Any) -> None:
    assert make(reduction=None).reduction == "mean"


def test_coefficients_can_be_assigned_and_are_checked() -> None:
    loss = make_bcq_loss(perturbation=True)
    buffer = loss.lmbda
    for value in (0.5, 1, np.float32(0.25)):
        loss.lmbda = value
        assert loss.lmbda is buffer
        assert loss.lmbda.item() == value
    with refused("lmbda is 1.5; valid: between 0 and 1"):
        loss.lmbda = 1.5
    with refused("kl_weight is 'high'; valid: at least 0"):
        loss.kl_weight = "high"
    loss.latent_clip = None
    assert run(loss, transitions(8))["loss_qvalue"].isfinite()
    assert "latent_clip" not in loss.state_dict()
    loss.latent_clip = 0.1
    assert loss.state_dict()["latent_clip"].item() == pytest.approx(0.1)
    assert loss.latent_clip.dtype == torch.float64


@pytest.mark.parametrize("value", [torch.tensor(5.0), torch.tensor(-1), torch.tensor(torch.nan)])
def test_a_coefficient_that_is_assigned_as_a_tensor_is_checked_too(value: Tensor) -> None:
    loss = make_bcq_loss()
    with refused("lmbda is tensor.*; valid: between 0 and 1"):
        loss.lmbda = value
    loss.lmbda = torch.tensor(1)
    loss.lmbda = 0.5
    assert loss.lmbda.item() == 0.5


@pytest.mark.parametrize("make", [make_distillation_loss, make_discrete_bcq_loss, make_plas_loss])
def test_an_assigned_coefficient_is_used_at_the_next_call(make: Any) -> None:
    name = {
        make_distillation_loss: "generator_weight",
        make_discrete_bcq_loss: "logits_weight",
        make_plas_loss: "kl_weight",
    }[make]
    data = {
        make_distillation_loss: task_transitions(3, 5),
        make_discrete_bcq_loss: discrete_transitions(8),
        make_plas_loss: transitions(8),
    }[make]
    loss = make()
    before = run(loss, data)["loss_generator"]
    setattr(loss, name, 3.0)
    expected = run(make(**{name: 3.0}), data)["loss_generator"]
    assert not torch.equal(before, expected)
    assert torch.equal(run(loss, data)["loss_generator"], expected)


def test_options_may_be_numpy_numbers_and_tensors() -> None:
    loss = make_bcq_loss(
        gamma=np.float64(0.9),
        lmbda=np.float32(0.5),
        num_candidates=np.int64(3),
        kl_weight=torch.tensor(0.25),
        bounds=(np.array([-1.0, -1.0]), np.ones(2)),
    )
    assert (loss.gamma, loss.num_candidates, type(loss.num_candidates)) == (0.9, 3, int)
    with refused(r"gamma is .*1.5.*; valid: between 0 and 1"):
        make_bcq_loss(gamma=np.float64(1.5))


def test_hydra_s_lists_serve_as_lists() -> None:
    omegaconf = pytest.importorskip("omegaconf")
    settings = omegaconf.OmegaConf.create(
        {"bounds": [-1.0, 1.0], "wide": [[-1.0, -1.0], [1.0, 1.0]], "range": [0.0, 9.0]}
    )
    for bounds in (settings.bounds, settings.wide):
        loss = make_bcq_loss(bounds=bounds, value_bounds=settings.range)
        assert (loss.action_low == -1).all()
        assert (loss.action_high == 1).all()
        loss(transitions(8))
    critics = omegaconf.ListConfig(make_critics(3, torch.float64), flags={"allow_objects": True})
    assert make_bcq_loss(critics=critics).num_qvalue_nets == 3
    terms = omegaconf.ListConfig(["classification"])
    assert make_distillation_loss(encoder_terms=terms).encoder_terms == ("classification",)
    assert make_distillation_loss(encoder_terms="metric").encoder_terms == ("metric",)


@pytest.mark.parametrize(
    ("action_space", "one_hot"),
    [
        ("one_hot", True),
        ("one-hot", True),
        (OneHot(3), True),
        (Composite(action=OneHot(3)), True),
        ("categorical", False),
        (Categorical(3), False),
    ],
)
def test_action_spaces_have_torchrl_s_names_or_are_specs(action_space: Any, one_hot: bool) -> None:
    name = "one-hot" if one_hot else "categorical"
    loss = make_discrete_bcq_loss(action_space=action_space)
    assert loss.action_space == name
    loss(discrete_transitions(8, action_space=name))


@pytest.mark.parametrize("make", [make_bcq_loss, make_plas_loss, make_discrete_bcq_loss])
def test_gamma_is_that_of_the_estimator(make: Any) -> None:
    loss: OfflineLoss = make(gamma=0.9)
    loss.make_value_estimator(gamma=0.5)
    assert loss.gamma == 0.5
    other = make()
    other.make_value_estimator(type(loss.value_estimator), gamma=0.25, value_network=None)
    assert other.gamma == 0.25
    loss.gamma = 0.75
    assert loss.value_estimator.gamma.item() == 0.75
    data = (discrete_transitions if make is make_discrete_bcq_loss else transitions)(8)
    value = torch.ones(8).double()
    alive = 1.0 - data["next", "terminated"].double().squeeze(-1)
    expected = data["next", "reward"].squeeze(-1) + 0.75 * alive
    torch.testing.assert_close(loss.td_target(data, value), expected)


def test_the_discount_of_a_loaded_state_is_the_loss_s() -> None:
    loss = make_bcq_loss()
    loss.load_state_dict(make_bcq_loss(gamma=0.5).state_dict())
    assert loss.gamma == 0.5
    loss.make_value_estimator()
    assert loss.value_estimator.gamma.item() == 0.5


# -- networks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [None, 2])
def test_a_lazy_critic_gets_its_sizes_from_the_generator(number: int | None) -> None:
    def lazy() -> TensorDictModule:
        return TensorDictModule(MLP(out_features=1, num_cells=[4]), **CRITIC_KEYS)

    vae, data = ActionVAE(*DIMS), transitions(8, dtype=torch.float32)
    loss = BCQLoss(vae, lazy() if number is None else [lazy(), lazy()], bounds=(-1.0, 1.0))
    before = [value.clone() for value in loss.target_qvalue_network_params.values(True, True)]
    assert len(set(loss.qvalue(data)[:, 0].tolist())) == 2
    total(loss(data)).backward()
    torch.optim.SGD(loss.parameters(), lr=1.0).step()
    SoftUpdate(loss, tau=0.5).step()
    after = loss.target_qvalue_network_params.values(True, True)
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("name", ["discrete", "plas"])
def test_lazy_networks_get_their_sizes_from_the_first_batch(name: str) -> None:
    def lazy(size: int, reads: list[str], *writes: str) -> TensorDictModule:
        network: Any = MLP(out_features=size, num_cells=[4])
        return TensorDictModule(network, reads, list(writes))

    if name == "discrete":
        critics = [lazy(3, ["observation"], "action_value") for _ in range(2)]
        loss: Any = DiscreteBCQLoss(lazy(3, ["observation"], "logits"), critics)
        data = discrete_transitions(8, dtype=torch.float32)
    else:
        actor = lazy(LATENT_DIM, ["observation"], "action_latent")
        critics = [lazy(1, ["observation", "action"], "state_action_value") for _ in range(2)]
        loss = PLASLoss(ActionVAE(*DIMS), actor, critics, bounds=(-1.0, 1.0))
        data = transitions(8, dtype=torch.float32)
    targets = SoftUpdate(loss, tau=0.5)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    values = []
    for _ in range(20):
        losses = loss(data)
        optimizer.zero_grad()
        total(losses).backward()
        optimizer.step()
        targets.step()
        values.append(losses["loss_generator"].item())
    assert values[-1] < values[0]
    state = loss.state_dict()
    assert all(value.isfinite().all() for value in state.values())
    for key, value in state.items():
        if key.startswith("target_") and key.endswith("weight"):
            source = state[key.removeprefix("target_")]
            assert 0 < (value - source).abs().max() < 1  # behind, and following


def test_a_generator_may_be_a_plain_module_of_its_parts() -> None:
    parts, vae = nn.Module(), ActionVAE(*DIMS).double()
    parts.encoder, parts.decoder, parts.latent_dim = vae.encoder, vae.decoder, vae.latent_dim
    torch.manual_seed(0)
    critics = make_critics(2, torch.float64)
    losses = [BCQLoss(g, critics, bounds=(-1.0, 1.0)) for g in (parts, vae)]
    results = [run(loss, transitions(8)) for loss in losses]
    assert all(torch.equal(value, results[1][key]) for key, value in results[0].items())


class Normalised(nn.Module):
    """A critic with BatchNorm, as CrossQ has it."""

    def __init__(self) -> None:
        super().__init__()
        size = OBSERVATION_DIM + ACTION_DIM
        self.network = nn.Sequential(
            nn.BatchNorm1d(size), nn.Linear(size, 8), nn.BatchNorm1d(8), nn.ReLU(), nn.Linear(8, 1)
        ).double()

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.network(torch.cat([observation, action], -1))


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("batch", [(8,), (2, 4)])
def test_critics_may_hold_batch_norm(number: int, batch: tuple[int, ...]) -> None:
    critics = [TensorDictModule(Normalised(), **CRITIC_KEYS) for _ in range(number)]
    generator = ActionVAE(*DIMS).double()
    loss, data = BCQLoss(generator, critics, bounds=(-1.0, 1.0)), transitions(*batch)
    targets = SoftUpdate(loss, tau=0.1)
    rows = data.reshape(-1).select("observation", "action")
    expected = torch.stack([x(rows.clone())["state_action_value"].view(batch) for x in critics])
    torch.testing.assert_close(loss.qvalue(data), expected)
    means = [v.clone() for k, v in loss.state_dict().items() if "running_mean" in k]
    total(loss(data)).backward()
    torch.optim.SGD(loss.parameters(), lr=0.1).step()
    targets.step()
    assert all(value.isfinite().all() for value in loss.state_dict().values())
    after = [v for k, v in loss.state_dict().items() if "running_mean" in k]
    assert any(not torch.equal(a, b) for a, b in zip(means, after, strict=True))


# -- data ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.bool])
def test_near_one_hot_actions_are_the_action_that_they_are_near(dtype: torch.dtype) -> None:
    loss, data = make_discrete_bcq_loss(), discrete_transitions(8)
    index = data["action"].argmax(-1)
    expected = run(loss, data)
    data["action"] = data["action"].to(dtype)
    if dtype.is_floating_point:
        data["action"] = data["action"] * 0.7 + 0.1  # a smoothed label
    assert torch.equal(loss.action_index(data, 3), index)
    assert all(torch.equal(value, expected[key]) for key, value in run(loss, data).items())


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
