"""Diagnostics tell whether candidates vary as the data do, and whether a critic leaves the data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import NO_UPDATER, guide
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.generators import candidates
from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.training.diagnostics import (
    Diagnostics,
    collapse_message,
    diagnose,
    outside_message,
    read_diagnostics,
    write_diagnostics,
)

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
Flow = guide("generators").Flow
NOISE = 0.2
"""Standard deviation of the demonstrator around the state's numbers."""


class Normal(TensorDictModuleBase):
    """Proposes the demonstrator's action with noise of a given size: it has no latent."""

    metrics, options = (), ()

    def __init__(self, noise: float | Tensor, scale: float = 1.0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action"]
        self.noise, self.weight = noise, nn.Parameter(torch.tensor(scale))

    def row_loss(self, tensordict: Any, keys: Any) -> Any:
        raise NotImplementedError

    def propose(self, observation: Any, num_candidates: int, keys: Any) -> Any:
        data = candidates(observation, num_candidates)
        mean = self.weight * data["observation"]
        return data.copy().set(keys.action, mean + self.noise * torch.randn(mean.shape))


class Along(nn.Module):
    """Values an action by its first component, in so many units."""

    def __init__(self, slope: float) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor(slope))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return observation[..., 1:2] + self.slope * action[..., :1]


def demonstrations(rows: int = 512, scale: float = 1.0) -> TensorDict:
    """Actions around the state's own numbers, with noise, in two dimensions."""
    torch.manual_seed(1)
    state = torch.rand(rows, 2) - 0.5
    action = scale * (state + NOISE * torch.randn(rows, 2))
    return TensorDict({"observation": state, "action": action}, [rows])


def agent(
    generator: Any, *, slope: float = 0.0, bounds: Any = (-2.0, 2.0), **options: Any
) -> BCQLoss:
    keys = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}
    critics = [TensorDictModule(Along(factor * slope), **keys) for factor in (1.0, -1.0)]
    torch.manual_seed(0)
    return BCQLoss(generator, critics, bounds=bounds, **options)


def autoencoder() -> BCQLoss:
    torch.manual_seed(0)
    generator = ActionVAE(2, 2, latent_dim=3, num_cells=(16,))
    critics = [make_qvalue_network(2, 2, num_cells=(16,)) for _ in range(2)]
    return BCQLoss(generator, critics, bounds=(-1.0, 1.0))


# -- spread ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_candidates", [2, 10, 100])
def test_a_generator_that_models_the_data_has_a_spread_ratio_of_one_for_any_number_of_candidates(
    num_candidates: int,
) -> None:
    found = diagnose(agent(Normal(NOISE)), demonstrations(4096), num_candidates=num_candidates)
    assert found.spread_ratio == pytest.approx(1.0, abs=0.03)
    assert found.candidate_spread == pytest.approx(NOISE / 2.0, rel=0.03)  # half the range is 2
    assert not found.collapsed
    assert not found.outside


@pytest.mark.parametrize("factor", [0.01, 0.1, 3.0])
def test_the_spread_ratio_is_that_of_the_generators_noise_to_the_datas(factor: float) -> None:
    found = diagnose(agent(Normal(factor * NOISE)), demonstrations())
    assert found.spread_ratio == pytest.approx(factor, rel=0.1)
    assert found.collapsed == (factor < 0.2)


def test_the_units_are_half_the_actions_range_in_each_dimension() -> None:
    loss, data = agent(Normal(NOISE)), demonstrations()
    wide = torch.tensor([2.0, 200.0])
    scaled = diagnose(agent(Normal(NOISE), bounds=(-wide, wide)), data)
    found = diagnose(loss, data)
    # Of two equal dimensions the second is now negligible.
    assert scaled.candidate_spread == pytest.approx(found.candidate_spread / 2**0.5, rel=0.05)
    still = torch.tensor([2.0, 0.0])  # no range: as it is
    assert math.isfinite(diagnose(agent(Normal(NOISE), bounds=(-still, still)), data).spread_ratio)


def test_one_candidate_still_has_a_spread_and_is_what_the_policy_chooses() -> None:
    found = diagnose(agent(Normal(NOISE), slope=5.0), demonstrations(4096), num_candidates=1)
    assert found.spread_ratio == pytest.approx(1.0, abs=0.05)
    assert found.qvalue_gap == pytest.approx(0.0, abs=0.05)


# -- chosen actions --------------------------------------------------------------------------------


def test_the_gap_is_what_the_first_critic_promises_for_the_best_candidate() -> None:
    slope, data = 5.0, demonstrations(4096)
    gaps = [
        diagnose(agent(Normal(NOISE), slope=slope), data, num_candidates=count).qvalue_gap
        for count in (1, 2, 100)
    ]
    # The largest of 1, 2 and 100 standard normal numbers is 0, 0.564 and 2.508 on average.
    assert gaps == pytest.approx([slope * NOISE * x for x in (0.0, 0.564, 2.508)], abs=0.05)
    found = diagnose(agent(Normal(NOISE), slope=slope), data)
    values = data["observation"][:, 1] + slope * data["action"][:, 0]
    assert found.qvalue_std == pytest.approx(values.std().item(), rel=1e-4)
    assert found.relative_gap == pytest.approx(found.qvalue_gap / found.qvalue_std)


@pytest.mark.parametrize("rule", ["mean", "min"])
def test_actions_are_valued_by_the_rule_that_the_policy_acts_by(rule: str) -> None:
    slope, data = 5.0, demonstrations()
    found = diagnose(agent(Normal(NOISE), slope=slope, acting_rule=rule), data)
    # The critics are s + 5 a and s - 5 a: their mean is s, their minimum s - |5 a|.
    penalty = slope * data["action"][:, 0].abs() * (rule == "min")
    values = data["observation"][:, 1] - penalty
    assert found.qvalue_std == pytest.approx(values.std().item(), rel=1e-4)
    if rule == "mean":
        assert found.qvalue_gap == pytest.approx(0.0, abs=1e-5)
    else:  # the best action is near 0, unless all candidates are far from it
        assert 0.8 < found.qvalue_gap / penalty.mean().item() < 1.0


def test_an_action_far_out_in_a_dimension_of_little_noise_is_outside() -> None:
    data, noise = demonstrations(2048), torch.tensor([NOISE / 100, NOISE])
    data["action"] = data["observation"] + noise * torch.randn(2048, 2)
    wider = noise * torch.tensor([3.0, 1.0])
    assert diagnose(agent(Normal(wider), slope=1.0), data).outside
    assert not diagnose(agent(Normal(noise), slope=1.0), data).outside


def test_a_wide_generator_and_a_critic_that_prefers_extremes_leave_the_data() -> None:
    found = diagnose(agent(Normal(3 * NOISE), slope=1.0), demonstrations(2048))
    assert found.outside_share > 0.9
    assert found.outside
    assert found.spread_ratio > 2.0


@pytest.mark.parametrize("num_candidates", [1, 10, 100])
def test_the_best_of_an_exact_generator_stays_inside_and_any_of_it_is_like_the_data(
    num_candidates: int,
) -> None:
    data, options = demonstrations(4096), {"num_candidates": num_candidates}
    assert not diagnose(agent(Normal(NOISE), slope=1.0), data, **options).outside
    indifferent = diagnose(agent(Normal(NOISE), slope=0.0), data, **options)
    assert indifferent.outside_share == pytest.approx(0.01, abs=0.005)


def test_a_demonstrators_noise_at_the_bounds_does_not_hide_chosen_actions_outside() -> None:
    data = demonstrations(2048)
    data["action"].clamp_(-0.5, 0.5)  # the plain range of all actions is that of the bounds
    assert diagnose(agent(Normal(3 * NOISE), slope=1.0), data).outside


# -- the latent ------------------------------------------------------------------------------------


def test_the_divergence_of_each_latent_dimension_is_the_closed_form() -> None:
    loss, data = autoencoder(), demonstrations(scale=0.5)
    with torch.no_grad():
        loss.generator_params["encoder", "module", "network", "2", "bias"][0] = 3.0
    found = diagnose(loss, data)
    encoded = loss.encode(data)
    loc, scale = encoded["action_latent_loc"], encoded["action_latent_scale"]
    standard = torch.distributions.Normal(0.0, 1.0)
    kl = torch.distributions.kl_divergence(torch.distributions.Normal(loc, scale), standard)
    assert found.latent_kl == pytest.approx(kl.mean(0).tolist(), rel=1e-4)
    assert found.active_latents == int((kl.mean(0) > 0.01).sum()) > 0
    assert found.metrics()["largest_latent_kl"] == max(found.latent_kl or ()) > 2.0


def test_a_posterior_that_is_the_prior_has_no_active_dimension_and_collapsed_candidates() -> None:
    loss = autoencoder()
    with torch.no_grad():
        for part, layer in (("encoder", "2"), ("decoder", "0")):
            params = loss.generator_params[part, "module", "network", layer]
            if part == "encoder":
                params["weight"].zero_()
                params["bias"].zero_()
            else:
                params["weight"][:, 2:] = 0.0  # the decoder ignores its latent
    found = diagnose(loss, demonstrations(scale=0.5))
    assert found.latent_kl == (0.0, 0.0, 0.0)
    assert found.active_latents == 0
    assert found.spread_ratio < 1e-3
    assert found.collapsed


def test_a_flow_has_diagnostics_without_a_latent() -> None:
    torch.manual_seed(0)
    found = diagnose(agent(Flow(2, 2), bounds=(-1.0, 1.0)), demonstrations(scale=0.5))
    assert found.latent_kl is None
    assert found.active_latents is None
    assert not {"active_latents", "largest_latent_kl"} & found.metrics().keys()
    assert all(map(math.isfinite, found.metrics().values()))


# -- use in training -------------------------------------------------------------------------------


def test_diagnostics_leave_random_numbers_agent_and_data_as_they_are() -> None:
    loss, data = autoencoder(), demonstrations(scale=0.5)
    state = torch.get_rng_state()
    weights = {key: x.clone() for key, x in loss.state_dict().items()}
    given = data.clone()
    first, second = diagnose(loss, data), diagnose(loss, data)
    assert torch.equal(torch.get_rng_state(), state)
    assert first == second
    assert (data == given).all()
    assert set(data.keys()) == set(given.keys())
    assert all(torch.equal(x, weights[key]) for key, x in loss.state_dict().items())


def test_members_of_a_stack_have_diagnostics_of_their_own() -> None:
    losses = [autoencoder() for _ in range(2)]
    with torch.no_grad():
        for value in losses[1].generator_params.parameters():
            value.mul_(2.0)
    data = demonstrations(scale=0.5)
    expected = [diagnose(loss, data) for loss in losses]
    stack = StackedLoss(losses)
    assert [diagnose(stack.member(index), data) for index in range(2)] == expected
    assert expected[0] != expected[1]


def test_batches_of_any_shape_give_the_same_diagnostics() -> None:
    loss, data = autoencoder(), demonstrations(scale=0.5)
    expected = diagnose(loss, data)
    assert diagnose(loss, data.reshape(8, 64)) == expected


@pytest.mark.parametrize("key", [("collector", "mask"), "mask"])
def test_padded_rows_do_not_count(key: Any) -> None:
    loss, data = autoencoder(), demonstrations(scale=0.5)
    loss.loss_mask_key = key
    expected = diagnose(loss, data[:300])
    padded = data.clone()
    for entry in ("observation", "action"):
        padded[entry][300:] = math.nan
    padded[key] = torch.arange(len(data)) < 300
    assert diagnose(loss, padded) == expected
    assert diagnose(loss, padded.reshape(8, 64)) == expected


# -- files and messages ----------------------------------------------------------------------------


def make(ratio: float = 1.0, share: float = 0.01, kl: Any = (0.5, 0.0)) -> Diagnostics:
    return Diagnostics(
        candidate_spread=0.1,
        spread_ratio=ratio,
        qvalue_gap=1 / 3,
        qvalue_std=2.0,
        outside_share=share,
        latent_kl=kl,
    )


@pytest.mark.parametrize("kl", [(0.5, 1 / 3), None])
def test_a_file_has_a_row_per_epoch_and_a_repeated_epoch_replaces_its_row(
    tmp_path: Path, kl: Any
) -> None:
    path = tmp_path / "bcq" / "lift" / "diagnostics.csv"
    for epoch, ratio in ((1, 0.1), (2, 0.2), (3, 0.3), (2, 0.4)):
        write_diagnostics(path, make(ratio, kl=kl), epoch=epoch, update=10 * epoch)
    # A run that was resumed from an earlier update writes the later rows again.
    assert read_diagnostics(path) == {10: make(0.1, kl=kl), 20: make(0.4, kl=kl)}


def test_numbers_that_are_not_finite_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "diagnostics.csv"
    write_diagnostics(path, make(math.inf, math.nan), epoch=1, update=10)
    write_diagnostics(path, make(), epoch=2, update=20)
    found = read_diagnostics(path)[10]
    assert math.isinf(found.spread_ratio)
    assert math.isnan(found.outside_share)
    path.write_text(path.read_text().replace("inf", "many"))
    with pytest.raises(DataError, match=r"spread_ratio: .*line 2 is 'many'; expected a number"):
        read_diagnostics(path)


def test_messages_name_all_agents_of_a_finding_once_and_what_to_do() -> None:
    found = {"reach": make(0.04), "lift": make(0.9), "push": make(0.081), "pull": make(2.0, 0.7)}
    assert collapse_message(found).startswith(
        "the candidates of reach, push vary less than the demonstrations (spread_ratio 0.04 to "
        "0.08, below 0.2), so these policies clone; "
    )
    for remedy in ("bcq.generator=gaussian", "bcq.kl_weight", "bcq.latent_clip=null"):
        assert remedy in collapse_message(found)
    assert outside_message(found).startswith(
        "pull: most chosen actions are unlike the demonstrations (outside_share 0.70, above 0.5)"
    )
    assert "fewer candidates (evaluate.num_candidates" in outside_message(found)
    for message in (collapse_message(found), outside_message(found)):  # the others refuse them
        advice = message.partition("with the autoencoder")[2]
        assert "bcq.kl_weight" in advice
        assert "bcq.latent_clip" in advice
    healthy = {"lift": make(0.9)}
    assert collapse_message(healthy) == outside_message(healthy) == ""
