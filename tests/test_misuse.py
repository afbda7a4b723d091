"""What a careful user does by mistake is an error that names it; what is right is accepted."""

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
    discrete_transitions,
    make_bcq_loss,
    make_critics,
    make_discrete_bcq_loss,
    make_discrete_network,
    make_distillation_loss,
    make_plas_loss,
    make_student_networks,
    make_teachers,
    run,
    task_transitions,
    total,
    transitions,
    undeclare,
    undeclared,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, Composite, OneHot
from torchrl.modules import MLP
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    OnlineTaskLatent,
    PLASPolicy,
    PrototypeTaskLatent,
    make_decoder,
    make_latent_actor,
    make_perturbation_network,
    make_qvalue_network,
    make_task_encoder,
)
from torchrl_bmrl.objectives import (
    BCQLoss,
    DiscreteBCQLoss,
    KeyedLoss,
    MetaDistillationLoss,
    OfflineLoss,
    PLASLoss,
    StackedLoss,
)

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
DIMS = (OBSERVATION_DIM, ACTION_DIM)
CRITIC = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}


def refused(message: str) -> Any:
    return pytest.raises(BMRLError, match=message)


# -- what is said in two places --------------------------------------------------------------------


@pytest.mark.parametrize("bounds", [(-2.0, 2.0), (-1.0, 2.0), ([-1.0, -2.0], [1.0, 1.0])])
def test_bounds_that_are_not_the_generator_s_are_refused(bounds: Any) -> None:
    with refused("bound of the action is .* and the generator's .*; valid: equal ones"):
        BCQLoss(ActionVAE(*DIMS), make_qvalue_network(*DIMS), bounds=bounds)
    spec = Bounded(*map(torch.tensor, bounds), shape=(ACTION_DIM,))
    with refused("valid: equal ones"):
        PLASLoss(
            ActionVAE(*DIMS),
            make_latent_actor(OBSERVATION_DIM, LATENT_DIM),
            make_qvalue_network(*DIMS),
            action_spec=spec,
        )
    loss = BCQLoss(ActionVAE(*DIMS, bounds=bounds), make_qvalue_network(*DIMS), action_spec=spec)
    assert torch.equal(loss.action_low.expand(ACTION_DIM), spec.space.low)


@pytest.mark.parametrize("length", [1, 3])
def test_bounds_of_another_length_than_the_action_are_refused(length: int) -> None:
    bounds = (-torch.ones(length), torch.ones(length))
    with refused(f"lower bound of the action has {length} numbers; valid: a number, or 2"):
        BCQLoss(ActionVAE(*DIMS), make_qvalue_network(*DIMS), bounds=bounds)
    loss = make_bcq_loss(bounds=bounds, edit=undeclare)
    with refused(rf"'action' has the shape \(8, 2\) and the bounds \({length},\)"):
        loss(transitions(8))


@pytest.mark.parametrize("make", [make_bcq_loss, make_plas_loss])
def test_actions_outside_the_bounds_are_refused_at_the_first_batch(make: Any) -> None:
    data = transitions(8)
    data["action"][5, 1] = 1.9
    with refused(r"'action' holds 1 numbers outside the bounds, the first, 1.9, at \(5, 1\)"):
        make()(data)
    data["action"][5, 1] = 1.0 + 1e-6  # rounding
    make()(data)


def critic(action_dim: int) -> TensorDictModule:
    """A user's critic, which does not say its sizes."""
    return TensorDictModule(MLP(OBSERVATION_DIM + action_dim, 1, num_cells=[4]), **CRITIC)


@pytest.mark.parametrize(
    "make", [lambda: make_qvalue_network(OBSERVATION_DIM, 3), lambda: critic(3)]
)
@pytest.mark.parametrize("several", [False, True])
def test_a_critic_of_another_action_is_refused_at_construction(
    make: Callable[[], TensorDictModule], several: bool
) -> None:
    critics = [make(), make()] if several else make()
    with refused("'action' has the size 2 in generator and 3 in|cannot read 'observation'"):
        BCQLoss(ActionVAE(*DIMS), critics, bounds=(-1.0, 1.0))
    BCQLoss(ActionVAE(*DIMS), critic(ACTION_DIM), bounds=(-1.0, 1.0))


def test_other_networks_of_other_sizes_are_refused_at_construction() -> None:
    vae, critics = ActionVAE(*DIMS), make_qvalue_network(*DIMS)
    with refused("'action' has the size 2 in generator and 3 in perturbation_network"):
        BCQLoss(vae, critics, make_perturbation_network(OBSERVATION_DIM, 3), bounds=(-1.0, 1.0))
    with refused("'action_latent' has the size 4 in generator and 7 in actor_network"):
        PLASLoss(vae, make_latent_actor(OBSERVATION_DIM, 7), critics, bounds=(-1.0, 1.0))
    mine = TensorDictModule(MLP(OBSERVATION_DIM, 7), ["observation"], ["action_latent"])
    with refused("actor_network writes 'action_latent' of the size 7; valid: 4"):
        PLASLoss(vae, mine, critics, bounds=(-1.0, 1.0))
    with refused("'observation' has the size 3 in generator and 5 in qvalue_network"):
        BCQLoss(vae, make_qvalue_network(5, ACTION_DIM), bounds=(-1.0, 1.0))


@pytest.mark.parametrize("latent_dim", [3, 5])
def test_a_latent_of_another_size_than_the_decoders_is_refused(latent_dim: int) -> None:
    students, (generators, critics) = make_student_networks(2, torch.float64), make_teachers(2)
    with refused(f"latent_dim is {latent_dim}; valid: 4"):
        MetaDistillationLoss(*students, generators, critics, latent_dim=latent_dim)
    decoder = make_decoder(*DIMS, LATENT_DIM)
    with refused(f"latent_dim is {latent_dim}; valid: 4, the generator's"):
        BCQPolicy(decoder, make_qvalue_network(*DIMS), latent_dim=latent_dim)
    with refused("latent_dim is None and the decoder does not declare it"):
        BCQPolicy(undeclared(decoder), make_qvalue_network(*DIMS))
    assert BCQPolicy(decoder, make_qvalue_network(*DIMS)).latent_dim == LATENT_DIM


def test_teachers_and_students_of_other_bounds_are_refused() -> None:
    students, (generators, critics) = make_student_networks(2, torch.float64), make_teachers(2)
    generators[1] = make_decoder(*DIMS, LATENT_DIM, bounds=(-2.0, 2.0)).double()
    with refused("lower bound of the action is -2.0, and the generator's -1.0; valid: equal ones"):
        MetaDistillationLoss(*students, generators, critics, latent_dim=LATENT_DIM)


def test_a_policy_perturbs_within_its_generator_s_bounds() -> None:
    networks = [make_qvalue_network(*DIMS), make_perturbation_network(*DIMS)]
    generator = ActionVAE(*DIMS, bounds=(-2.0, 2.0))
    assert BCQPolicy(generator, *networks).action_high.item() == 2.0
    with refused("lower bound of the action is -1.0, and the generator's -2.0; valid: equal ones"):
        BCQPolicy(generator, *networks, bounds=(-1.0, 1.0))
    with refused("bounds are None; valid"):
        decoder = undeclared(generator.decoder)
        PLASPolicy(make_latent_actor(OBSERVATION_DIM, LATENT_DIM), decoder, networks[1])


def test_numbers_of_actions_that_differ_are_refused() -> None:
    generator = make_discrete_network("logits", torch.float64)
    single = TensorDictModule(MLP(OBSERVATION_DIM, 1).double(), ["observation"], ["action_value"])
    loss = DiscreteBCQLoss(generator, single)
    with refused(r"'action_value' has the shape \(8, 1\); valid: \(8, 3\)"):
        loss(discrete_transitions(8))
    loss = make_discrete_bcq_loss(action_space=OneHot(4))
    with refused(r"'logits' has the shape \(8, 3\), and the spec of the action 4 actions"):
        loss(discrete_transitions(8))


# -- who is trained --------------------------------------------------------------------------------


def test_a_policy_of_a_critic_that_a_loss_has_copied_is_refused() -> None:
    generator, critics = ActionVAE(*DIMS), [make_qvalue_network(*DIMS) for _ in range(2)]
    BCQPolicy(generator, critics[0])  # not yet
    BCQLoss(generator, critics, bounds=(-1.0, 1.0))
    with refused(
        r"qvalue_network was copied into a BCQLoss.*valid: .*live\(loss\).*frozen\(loss\)"
    ):
        BCQPolicy(generator, critics[0])
    alone = make_qvalue_network(*DIMS)
    BCQLoss(ActionVAE(*DIMS), alone, num_qvalue_nets=1, bounds=(-1.0, 1.0))
    BCQPolicy(generator, alone)  # the loss trains this one itself


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("also", [False, True])
def test_an_action_renamed_in_the_loss_alone_names_the_networks_that_read_the_old_name(
    also: bool,
) -> None:
    loss, data = make_bcq_loss(), transitions(8)
    loss.set_keys(action="act")
    if also:  # both names in the data: nothing would fail by itself
        data["act"] = data["action"].flip(0)
    else:
        data.rename_key_("action", "act")
    with refused(r"set_keys\(action='act'\).*generator and qvalue_network read as 'action'"):
        loss(data)


def test_a_missing_entry_names_who_reads_it() -> None:
    with refused("no 'action', which generator and qvalue_network read"):
        make_bcq_loss()(transitions(8).exclude("action"))


def test_the_first_argument_of_every_source_of_m_is_m() -> None:
    encoder, point = make_task_encoder(*DIMS), torch.zeros(2)
    assert torch.equal(OnlineTaskLatent(point, encoder).task_latent, point)
    with refused("task_latent is a Network; valid: a tensor"):
        OnlineTaskLatent(encoder, point)
    with refused("task_latent is a Network; valid: a tensor"):
        PrototypeTaskLatent(encoder)


# -- one-hot actions -------------------------------------------------------------------------------


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


@pytest.mark.parametrize("row", [[0, 0, 0], [1, 1, 0], [0.5, 0.5, 0], [0.4, 0.3, 0.3], [-1, 0, 0]])
def test_rows_that_name_no_single_action_are_refused(row: list[float]) -> None:
    loss, data = make_discrete_bcq_loss(), discrete_transitions(8)
    data["action"] = data["action"].double()
    data["action"][2] = torch.tensor(row).double()
    with refused(r"'action' names no single action in 1 rows, the first, \[.*\], at \(2,\)"):
        loss(data)


# -- refused though right --------------------------------------------------------------------------


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
    assert torch.equal(run(loss, data)["loss_generator"], expected) != torch.equal(before, expected)


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


def test_the_message_of_another_number_of_categories_names_the_valid_shapes() -> None:
    loss, data = make_discrete_bcq_loss(action_space="categorical"), discrete_transitions(8)
    data["action"] = torch.zeros(8, 64, dtype=torch.int64)
    with refused(r"\(8, 64\); valid for action_space='categorical': \(8,\) or \(8, 1\)"):
        loss(data)


@pytest.mark.parametrize("number", [None, 2])
def test_a_lazy_critic_gets_its_sizes_from_the_generator(number: int | None) -> None:
    def lazy() -> TensorDictModule:
        return TensorDictModule(MLP(out_features=1, num_cells=[4]), **CRITIC)

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


def test_a_stack_of_lazy_losses_is_refused() -> None:
    def build() -> DiscreteBCQLoss:
        critic = TensorDictModule(MLP(out_features=3), ["observation"], ["action_value"])
        return DiscreteBCQLoss(make_discrete_network("logits", torch.float32), critic)

    with refused("parameters without a shape; valid: losses that have run once"):
        StackedLoss([build(), build()])


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
    critics = [TensorDictModule(Normalised(), **CRITIC) for _ in range(number)]
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


def test_data_of_another_type_name_the_transform_that_converts_them() -> None:
    with refused("torch.float64.*parameters are torch.float32.*DoubleToFloat"):
        make_bcq_loss(dtype=torch.float32)(transitions(8))


class Forgetful(KeyedLoss):
    """A loss whose author forgot to say what it reads."""


def test_what_an_own_loss_lacks_is_named() -> None:
    with pytest.raises(NotImplementedError, match=r"Forgetful has no read_keys\(\); valid: .*keys"):
        _ = Forgetful().in_keys
    with pytest.raises(NotImplementedError, match=r"Forgetful has no written_keys\(\); valid"):
        _ = Forgetful().out_keys
    with refused(r"register_coefficients\(alpha\) before the loss has a network"):
        Forgetful().register_coefficients(alpha=1.0)


@pytest.mark.parametrize("make", [make_bcq_loss, make_plas_loss, make_discrete_bcq_loss])
def test_gamma_is_that_of_the_estimator(make: Any) -> None:
    loss: OfflineLoss = make(gamma=0.9)
    loss.make_value_estimator(gamma=0.5)
    assert loss.gamma == 0.5
    assert make().make_value_estimator(type(loss.value_estimator), gamma=0.25, value_network=None)
    loss.gamma = 0.75
    assert loss.value_estimator.gamma.item() == 0.75
    data = (discrete_transitions if make is make_discrete_bcq_loss else transitions)(8)
    value = torch.ones(8).double()
    alive = 1.0 - data["next", "terminated"].double().squeeze(-1)
    expected = data["next", "reward"].squeeze(-1) + 0.75 * alive
    torch.testing.assert_close(loss.td_target(data, value), expected)


# -- stacks ----------------------------------------------------------------------------------------


def stack(number: int = 2, **options: Any) -> tuple[StackedLoss, TensorDict]:
    losses = [make_bcq_loss(seed=seed, **options) for seed in range(number)]
    return StackedLoss(losses), torch.stack([transitions(8, seed=seed) for seed in range(number)])


def test_the_summed_losses_of_a_stack_give_every_member_its_own_gradient() -> None:
    losses, data = stack()
    total(run(losses, data)).backward()
    for index in range(2):
        alone = make_bcq_loss(seed=index)
        alone.generator_loss(data[index])[0].backward()
        stacked = losses.generator_params["encoder", "module", "network", "0", "weight"].grad
        # Another draw of z; the same scale.
        own = alone.generator_params["encoder", "module", "network", "0", "weight"].grad
        assert 0.2 < stacked[index].norm() / own.norm() < 5


def test_a_stack_is_called_with_keywords_and_selects_its_outputs() -> None:
    losses, data = stack()
    keywords = {
        "_".join((key,) if isinstance(key, str) else key): data[key] for key in losses.in_keys
    }
    torch.manual_seed(0)
    results = losses(**keywords)
    expected = run(losses, data)
    assert losses.out_keys == list(expected.keys())
    for key, value in zip(losses.out_keys, results, strict=True):
        assert torch.equal(value, expected[key]), key
    losses.select_out_keys("loss_qvalue")
    assert list(losses(data).keys()) == ["loss_qvalue"]


def test_parameters_of_a_stack_are_initialised_anew() -> None:
    losses, _ = stack()
    before = {key: value.clone() for key, value in losses.state_dict().items()}
    losses.reset_parameters_recursive()
    after = losses.state_dict()
    weights = [key for key in before if key.endswith("weight") and "." in key]
    assert weights
    for key in weights:
        assert not torch.equal(after[key], before[key]), key
        assert not torch.equal(after[key][0], after[key][1]), key
    for name in ("weight", "bias"):
        path = ("module", "0", name)
        assert torch.equal(
            losses.qvalue_network_params[path], losses.target_qvalue_network_params[path]
        )


def test_keys_masks_estimators_and_coefficients_of_a_stack_are_its_members() -> None:
    losses, data = stack()
    losses.make_value_estimator(gamma=0.5)
    losses.kl_weight = 2.0
    losses.loss_mask_key = "valid"
    losses.set_keys(reward="points")
    data["next", "points"] = data["next"].pop("reward")
    data["valid"] = torch.arange(8).expand(2, 8) < 6
    assert losses.kl_weight.tolist() == [2.0, 2.0]
    assert (losses.gamma, losses.loss_mask_key) == (0.5, "valid")
    _, metrics = losses.qvalue_loss(data)
    for index in range(2):
        alone = make_bcq_loss(seed=index, gamma=0.5, kl_weight=2.0)
        alone.loss_mask_key = "valid"
        alone.set_keys(reward="points")
        own = alone.qvalue_loss(data[index])[1]
        torch.testing.assert_close(metrics["pred_value"][index], own["pred_value"])
        member = losses.member(index)
        assert (member.gamma, member.kl_weight.item(), member.loss_mask_key) == (0.5, 2.0, "valid")


def test_reset_critics_differ_and_have_the_scale_of_fresh_ones() -> None:
    loss = make_bcq_loss()
    fresh = make_critics(1, torch.float64)[0].module[0].weight.std().item()
    loss.reset_parameters_recursive()
    weight = loss.qvalue_network_params["module", "0", "weight"]
    assert not torch.equal(weight[0], weight[1])
    assert 0.7 < weight.std().item() / fresh < 1.4
    target = loss.target_qvalue_network_params["module", "0", "weight"]
    assert torch.equal(weight, target)
