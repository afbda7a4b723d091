"""A mistake in bounds, sizes, names or data is refused with an error that names it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
    guide,
    make_bcq_loss,
    make_discrete_bcq_loss,
    make_discrete_network,
    make_distillation_loss,
    make_plas_loss,
    make_student_networks,
    make_teachers,
    refused,
    task_transitions,
    transitions,
    undeclare,
    undeclared,
)
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Binary, Bounded, Composite, MultiOneHot, OneHot
from torchrl.modules import MLP

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
    PLASLoss,
)

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


# -- bounds ----------------------------------------------------------------------------------------


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


def test_bounds_are_compared_whole_and_are_finite() -> None:
    generator = ActionVAE(*DIMS, bounds=(-1.5, 1.5))
    with refused("valid: equal ones"):
        whole = (torch.tensor(-1), torch.tensor(1))
        BCQLoss(generator, make_qvalue_network(*DIMS), bounds=whole)
    with refused("bound of the action is .*-1.0.*, and the generator's .*-1.5"):
        BCQPolicy(generator, make_qvalue_network(*DIMS), bounds=(-1, 1))
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, torch.inf]), shape=(2,))
    with refused("bounds of the action are .*inf.*; valid: finite numbers"):
        make_bcq_loss(bounds=None, action_spec=spec)


@pytest.mark.parametrize("make", [make_bcq_loss, make_plas_loss])
def test_actions_outside_the_bounds_are_refused_at_the_first_batch(make: Any) -> None:
    data = transitions(8)
    data["action"][5, 1] = 1.9
    with refused(r"'action' holds 1 numbers outside the bounds, the first, 1.9, at \(5, 1\)"):
        make()(data)
    data["action"][5, 1] = 1.0 + 1e-6  # rounding
    make()(data)


@pytest.mark.parametrize("key", ["action", ("next", "action")])
def test_actions_that_rebrac_compares_outside_the_bounds_are_refused(key: Any) -> None:
    data = guide().next_actions(8)
    data[key][5, 1] = 1.9
    with refused(r"'action'.* holds 1 numbers outside the bounds, the first, 1.9, at \(5, 1\)"):
        guide().TestReBRACLoss.case.make()(data)


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


# -- sizes -----------------------------------------------------------------------------------------


def critic(action_dim: int) -> TensorDictModule:
    """A user's critic, which does not declare its sizes."""
    return TensorDictModule(MLP(OBSERVATION_DIM + action_dim, 1, num_cells=[4]), **CRITIC_KEYS)


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


def test_numbers_of_actions_that_differ_are_refused() -> None:
    generator = make_discrete_network("logits", torch.float64)
    single = TensorDictModule(MLP(OBSERVATION_DIM, 1).double(), ["observation"], ["action_value"])
    loss = DiscreteBCQLoss(generator, single)
    with refused(r"'action_value' has the shape \(8, 1\); valid: \(8, 3\)"):
        loss(discrete_transitions(8))
    loss = make_discrete_bcq_loss(action_space=OneHot(4))
    with refused(r"'logits' has the shape \(8, 3\), and the spec of the action 4 actions"):
        loss(discrete_transitions(8))


# -- names and specs -------------------------------------------------------------------------------


@pytest.mark.parametrize("also", [False, True])
def test_an_action_renamed_in_the_loss_alone_names_the_networks_that_read_the_old_name(
    also: bool,
) -> None:
    loss, data = make_bcq_loss(), transitions(8)
    loss.set_keys(action="act")
    if also:  # the data have both names, so that no key is missing
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


def test_specs_of_several_actions_at_once_are_refused_and_nested_ones_found() -> None:
    def build(spec: Any) -> DiscreteBCQLoss:
        networks = [
            TensorDictModule(nn.Linear(3, 3), ["observation"], [key])
            for key in ("logits", "action_value")
        ]
        return DiscreteBCQLoss(*networks, action_space=spec)

    for spec in (MultiOneHot([2, 2]), Binary(3)):
        with refused("valid .*: one-hot, categorical"):
            build(spec)
    assert build(Composite(agent=Composite(move=OneHot(3)))).num_actions == 3
    with refused(r"the spec has .*, not 'action'; valid: the spec of the action alone"):
        build(Composite(one=OneHot(3), two=OneHot(3)))


class Forgetful(KeyedLoss):
    """A loss whose author forgot to declare its keys."""


def test_what_an_own_loss_lacks_is_named() -> None:
    with pytest.raises(NotImplementedError, match=r"Forgetful has no read_keys\(\); valid: .*keys"):
        _ = Forgetful().in_keys
    with pytest.raises(NotImplementedError, match=r"Forgetful has no written_keys\(\); valid"):
        _ = Forgetful().out_keys
    with refused(r"register_coefficients\(alpha\) before the loss has a network"):
        Forgetful().register_coefficients(alpha=1.0)


# -- data ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", [[0, 0, 0], [1, 1, 0], [0.5, 0.5, 0], [0.4, 0.3, 0.3], [-1, 0, 0]])
def test_rows_that_name_no_single_action_are_refused(row: list[float]) -> None:
    loss, data = make_discrete_bcq_loss(), discrete_transitions(8)
    data["action"] = data["action"].double()
    data["action"][2] = torch.tensor(row).double()
    with refused(r"'action' names no single action in 1 rows, the first, \[.*\], at \(2,\)"):
        loss(data)


def test_the_message_of_another_number_of_categories_names_the_valid_shapes() -> None:
    loss, data = make_discrete_bcq_loss(action_space="categorical"), discrete_transitions(8)
    data["action"] = torch.zeros(8, 64, dtype=torch.int64)
    with refused(r"\(8, 64\); valid for action_space='categorical': \(8,\) or \(8, 1\)"):
        loss(data)


def test_data_of_another_type_name_the_transform_that_converts_them() -> None:
    with refused("torch.float64.*parameters are torch.float32.*DoubleToFloat"):
        make_bcq_loss(dtype=torch.float32)(transitions(8))


def test_rows_of_another_task_than_their_number_are_refused() -> None:
    data = task_transitions(3, 5)
    data["task"] = data["task"].flip(0)
    with refused("'task' holds 2 in row 0; valid: 0 there"):
        make_distillation_loss()(data)


def test_weights_that_are_not_finite_are_refused_and_no_weight_at_all_is_no_nan() -> None:
    loss, data = make_bcq_loss(), transitions(8)
    data["priority_weight"] = torch.ones(8).double()
    data["priority_weight"][3] = torch.nan
    with refused("'priority_weight' holds 1 numbers that are not finite"):
        loss(data)
    data["collector", "mask"] = torch.zeros(8, 1, dtype=torch.bool)
    assert loss(data)["loss_qvalue"] == 0
    data["collector", "mask"] = data["collector", "mask"].double()
    with refused("mask .* is torch.float64; valid: torch.bool"):
        loss(data)
