"""The contract that every loss of the library holds: a new loss is one line in ``CASES``.

What belongs to the equations of one loss is tested in that loss's own file.
"""

from __future__ import annotations

import ast
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    NO_UPDATER,
    OBSERVATION_DIM,
    Dropped,
    OnTorso,
    as_keywords,
    discrete_transitions,
    gradients,
    guide,
    make_bcq_loss,
    make_discrete_bcq_loss,
    make_distillation_loss,
    make_emaq_loss,
    make_plas_loss,
    reached,
    run,
    state,
    task_transitions,
    total,
    transitions,
)
from tensordict import TensorDict, unravel_key
from tensordict.nn import CudaGraphModule, TensorDictModule
from torch import Tensor, nn
from torchrl.data import (
    Bounded,
    LazyTensorStorage,
    MultiStep,
    TensorDictPrioritizedReplayBuffer,
    Unbounded,
)
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import OfflineLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
Networks = dict[str, set[str]]


@dataclass(frozen=True)
class Case:
    """A loss, data for it, and what it claims.

    Attributes:
        make: builds a small loss; options go to the loss, ``edit`` sees every network.
        data: builds a batch from its shape.
        trains: networks that each term ``loss_*`` sends gradients to.
        targets: networks that have a target.
        offline: it is an ``OfflineLoss``: a method per term, critics, value estimators, batches of
            any shape.
        shape: of the batch.
    """

    make: Callable[..., Any]
    data: Callable[..., TensorDict]
    trains: Networks
    targets: tuple[str, ...] = ()
    offline: bool = True
    shape: tuple[int, ...] = (8,)

    def batch(self, *shape: int, dtype: torch.dtype = torch.float64) -> TensorDict:
        return self.data(*(shape or self.shape), dtype=dtype)


Q, XI, M, G = "qvalue_network", "perturbation_network", "task_encoder", "student_generator"
CRITICS: Networks = {"generator": {"generator"}, "qvalue": {Q}}
STUDENT: Networks = {
    "classification": {M, "task_classifier"},
    "generator": {M, G},
    "direction": {M, G},
    "qvalue": {M, "student_qvalue_network"},
    "latent_norm": {M},
}


def offline(make: Any, data: Any, targets: tuple[str, ...] = (Q,), **trains: set[str]) -> Case:
    return Case(make, data, CRITICS | trains, targets)


def student(trains: Networks = STUDENT, **options: Any) -> Case:
    make = partial(make_distillation_loss, **options)
    return Case(make, task_transitions, trains, offline=False, shape=(3, 5))


PERTURBED = {"perturbation": True}
CATEGORICAL = {"action_space": "categorical"}
DISCRETE = make_discrete_bcq_loss, discrete_transitions
ACTOR = "actor_network"
CASES = {
    "bcq": offline(make_bcq_loss, transitions),
    "bcq_perturbed": offline(
        partial(make_bcq_loss, **PERTURBED), transitions, (Q, XI), perturbation={XI}
    ),
    "plas": offline(make_plas_loss, transitions, (Q, ACTOR), actor={ACTOR}),
    "plas_perturbed": offline(
        partial(make_plas_loss, **PERTURBED), transitions, (Q, ACTOR, XI), actor={ACTOR, XI}
    ),
    "emaq_of_the_guide": offline(make_emaq_loss, transitions),
    "discrete_bcq": offline(*DISCRETE),
    "discrete_bcq_categorical": offline(*(partial(f, **CATEGORICAL) for f in DISCRETE)),
    "distillation": student(context="current"),
    "distillation_previous": student(context="previous"),
    "distillation_random": student(context="random"),
    "distillation_metric": student(STUDENT | {"metric": {M}}, context="set", metric_weight=0.5),
}
OFFLINE = {name: case for name, case in CASES.items() if case.offline}
STUDENTS = {name: case for name, case in CASES.items() if not case.offline}
every = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
every_offline = pytest.mark.parametrize("case", OFFLINE.values(), ids=OFFLINE)
every_student = pytest.mark.parametrize("case", STUDENTS.values(), ids=STUDENTS)
VALUES = ("state_action_value", "action_value")  # what critics write


def same(a: TensorDict, b: TensorDict) -> bool:
    """Equal keys and exactly equal values."""
    keys = set(a.keys(True, True))
    return keys == set(b.keys(True, True)) and all(torch.equal(a[key], b[key]) for key in keys)


def critics_of(case: Case, number: int) -> list[TensorDictModule]:
    """Networks such as the case's own critics."""
    seen: list[TensorDictModule] = []
    case.make(num_critics=number, edit=lambda module: seen.append(module) or module)
    return [module for module in seen if module.out_keys[-1] in VALUES]


# -- the lines above ---------------------------------------------------------------------------


@every
def test_a_case_says_what_its_loss_offers(case: Case) -> None:
    loss = case.make()
    terms = [key.removeprefix("loss_") for key in loss.out_keys if key.startswith("loss_")]
    assert set(terms) == case.trains.keys()
    targets = {name for name, _ in loss.named_children() if name.startswith("target_")}
    assert targets == {f"target_{name}_params" for name in case.targets}
    assert isinstance(loss, OfflineLoss) == case.offline
    methods = {name[:-5] for name in dir(loss) if name.endswith("_loss") and name[0] != "_"}
    # BCQLoss always has a perturbation_loss, which refuses to run without a network.
    assert methods - {"perturbation"} == (set(terms) - {"perturbation"} if case.offline else set())


def test_every_loss_of_the_library_has_a_case() -> None:
    from torchrl_bmrl import objectives

    losses = {getattr(objectives, name) for name in objectives.__all__ if name.endswith("Loss")}
    losses -= {objectives.StackedLoss}  # holds the others; tests/test_stacked.py goes over CASES
    bases = {base for loss in losses for base in loss.__mro__[1:]}
    assert losses - bases == {type(case.make()) for case in CASES.values()} - {guide().EMaQLoss}


# -- keys --------------------------------------------------------------------------------------


def renaming(loss: LossModule) -> dict[str, Any]:
    """A nested name for every key that ``set_keys`` knows, and for the observation."""
    accepted = asdict(loss.default_keys())
    names = {key: ("my", name) for name, key in accepted.items()}
    apart = {"observation": ("agent", "s"), "td_error": ("buffer", "p"), "priority_weight": "w"}
    return names | apart


def renamed(key: Any, names: dict[str, Any]) -> Any:
    if isinstance(key, tuple) and key[0] in ("next", "previous"):
        rest = key[1] if len(key) == 2 else key[1:]
        return unravel_key((names.get(key[0], key[0]), renamed(rest, names)))
    return names.get(key, key)


@every
def test_renamed_and_nested_keys_give_the_same_losses(case: Case) -> None:
    def edit(module: TensorDictModule) -> TensorDictModule:
        keys = ([renamed(key, names) for key in k] for k in (module.in_keys, module.out_keys))
        return TensorDictModule(module.module, *keys)

    loss = case.make()
    names = renaming(loss)
    other = case.make(edit=edit)
    other.set_keys(**{name: names[key] for name, key in asdict(loss.default_keys()).items()})
    assert other.in_keys == [renamed(key, names) for key in loss.in_keys]
    data = case.batch()
    data["priority_weight"] = torch.linspace(0.1, 1.0, data.numel()).view(data.shape).double()
    renamed_data = TensorDict({}, data.batch_size)
    for key, value in data.items(True, True):
        renamed_data.set(renamed(key, names), value)
    keywords = as_keywords(renamed_data, other.in_keys)
    assert same(run(loss, data), run(other, renamed_data))
    assert torch.equal(data["td_error"], renamed_data["buffer", "p"])
    expected = run(loss, data.exclude("priority_weight"))
    torch.manual_seed(0)
    for key, value in zip(other.out_keys, other(**keywords), strict=True):
        assert torch.equal(value, expected[key]), key


@every
def test_a_key_set_to_none_has_its_default_again(case: Case) -> None:
    loss, fresh = case.make(), case.make()
    for name, default in asdict(loss.default_keys()).items():
        loss.set_keys(**{name: ("my", name)})
        assert getattr(loss.tensor_keys, name) == ("my", name)
        for key in fresh.in_keys:  # what a network reads keeps the network's name
            assert {key, renamed(key, {default: ("my", name)})} & set(loss.in_keys)
        loss.set_keys(**{name: None})
        assert loss.tensor_keys == fresh.tensor_keys
        assert loss.in_keys == fresh.in_keys


@every
def test_an_unknown_key_is_refused_with_the_accepted_ones(case: Case) -> None:
    with pytest.raises(ValueError, match=r"goal is not an accepted tensordict key.*priority"):
        case.make().set_keys(goal="g")


@every
def test_in_keys_are_stable_and_can_be_set(case: Case) -> None:
    loss = case.make()
    assert loss.in_keys == loss.in_keys == case.make().in_keys
    assert len(set(loss.in_keys)) == len(loss.in_keys)
    loss.in_keys = ["observation", "action"]
    assert loss.in_keys == ["observation", "action"]


def test_keys_have_the_same_order_in_another_process() -> None:
    code = "from test_loss_contract import keys_of_all; print(keys_of_all())"
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parent,
        env=os.environ | {"PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ast.literal_eval(result.stdout.splitlines()[-1]) == keys_of_all()


def keys_of_all() -> dict[str, list[Any]]:
    losses = {name: case.make() for name, case in CASES.items()}
    return {name: [*loss.in_keys, *loss.out_keys] for name, loss in losses.items()}


@every
def test_only_the_in_keys_are_read_and_all_of_them_are_needed(case: Case) -> None:
    loss, data = case.make(), case.batch()
    assert same(run(loss, data.clone()), run(loss, data.select(*loss.in_keys)))
    for key in loss.in_keys:
        refused(loss, data.exclude(key), f"no {key!r}")


@every
def test_tensordict_and_keywords_give_the_out_keys_in_order(case: Case) -> None:
    loss, data = case.make(), case.batch()
    expected = run(loss, data)
    assert list(expected.keys()) == loss.out_keys == case.make().out_keys
    torch.manual_seed(0)
    result = loss(**as_keywords(data, loss.in_keys))
    for key, value in zip(loss.out_keys, result, strict=True):
        assert torch.equal(value, expected[key]), key


@every
def test_selected_out_keys_are_all_that_is_returned(case: Case) -> None:
    loss = case.make()
    loss.select_out_keys("loss_qvalue")
    assert list(loss(case.batch()).keys()) == ["loss_qvalue"]
    assert isinstance(loss(**as_keywords(case.batch(), loss.in_keys)), Tensor)


# -- reduction, masks, weights, priority -------------------------------------------------------


def reduced(case: Case, reduction: str, data: TensorDict, **options: Any) -> dict[str, Tensor]:
    """The terms under one reduction."""
    losses = run(case.make(reduction=reduction, **options), data)
    return {term: losses[f"loss_{term}"] for term in case.trains}


@every
def test_reductions_agree(case: Case) -> None:
    rows, sums, means = (reduced(case, name, case.batch()) for name in ("none", "sum", "mean"))
    for term in case.trains:
        assert rows[term].shape == case.shape
        torch.testing.assert_close(sums[term], rows[term].sum())
        torch.testing.assert_close(means[term], rows[term].mean())


@every
@pytest.mark.parametrize("key", [("collector", "mask"), "valid"])
def test_masked_rows_do_not_count_in_any_term(case: Case, key: Any) -> None:
    loss, data = case.make(), case.batch()
    rows = reduced(case, "none", data)
    mask = torch.arange(data.numel()).view(case.shape) % 3 > 0
    data[key] = mask.unsqueeze(-1)
    if key == "valid":
        loss.loss_mask_key = key
    losses = run(loss, data)
    for term in case.trains:
        torch.testing.assert_close(losses[f"loss_{term}"], rows[term][mask].mean())


@every
@pytest.mark.parametrize("use", ["auto", True, False])
def test_priority_weights_weigh_every_term(case: Case, use: str | bool) -> None:
    data = case.batch()
    rows = reduced(case, "none", data)
    weight = torch.linspace(0.1, 1.0, data.numel(), dtype=torch.float64).view(case.shape)
    data["priority_weight"] = weight
    values = reduced(case, "mean", data, use_prioritized_weights=use)
    for term, row in rows.items():
        expected = row.mean() if use is False else (row * weight).sum() / weight.sum()
        torch.testing.assert_close(values[term], expected)


@every
def test_the_key_of_the_priority_weights_may_be_nested(case: Case) -> None:
    loss, data = case.make(), case.batch()
    data["priority_weight"] = weight = torch.linspace(0.1, 1.0, data.numel()).view(case.shape)
    expected = run(loss, data)
    loss.set_keys(priority_weight=("buffer", "weight"))
    data = case.batch()
    run(loss, data)  # without weights, too
    data["buffer", "weight"] = weight
    assert same(run(loss, data), expected)


@every
def test_forward_writes_the_priority_and_leaves_the_rest_of_the_input(case: Case) -> None:
    loss, data = case.make(), case.batch()
    before, values = dict(data.items(True, True)), data.clone()
    run(loss, data)
    priority = data.pop("td_error")
    assert priority.shape == case.shape
    assert priority.isfinite().all()
    assert (priority >= 0).all()
    assert len(priority.unique()) > 1
    assert not priority.requires_grad
    after = dict(data.items(True, True))
    assert after.keys() == before.keys()
    assert all(after[key] is value for key, value in before.items())
    assert same(data, values)


@every_offline
def test_methods_leave_the_input_and_are_the_terms_of_forward(case: Case) -> None:
    loss, data = case.make(), case.batch()
    before, values = dict(data.items(True, True)), data.clone()
    torch.manual_seed(0)
    results = {term: getattr(loss, f"{term}_loss")(data) for term in case.trains}
    after = dict(data.items(True, True))
    assert after.keys() == before.keys()
    assert all(after[key] is value for key, value in before.items())
    assert same(data, values)
    losses = run(loss, data)
    for term, (value, info) in results.items():
        assert torch.equal(value, losses[f"loss_{term}"])
        for key in info.keys() & set(loss.out_keys):
            assert torch.equal(info[key], losses[key])
    assert torch.equal(data["td_error"], results["qvalue"][1]["td_error"].amax(0))


@every
def test_a_prioritised_buffer_takes_the_priority_back(case: Case) -> None:
    data = case.batch(dtype=torch.float32).reshape(-1)  # the buffer's sampler takes no other
    try:
        buffer = TensorDictPrioritizedReplayBuffer(
            alpha=1.0,
            beta=1.0,
            eps=0.0,
            priority_key="td_error",
            storage=LazyTensorStorage(len(data)),
            batch_size=len(data),
        )
    except RuntimeError as error:
        if "SumSegmentTreeFp32 is not available" not in str(error):
            raise
        pytest.skip("this torch lacks torchrl's C++ sampler: SumSegmentTreeFp32 is not available")
    buffer.extend(data)
    loss = case.make(dtype=torch.float32)
    sample = buffer.sample().reshape(case.shape)
    assert (sample["priority_weight"] == 1).all()
    loss(sample)
    buffer.update_tensordict_priority(sample.reshape(-1))
    assert len(buffer.sample()["priority_weight"].unique()) > 1
    loss(buffer.sample().reshape(case.shape))


# -- gradients and targets ---------------------------------------------------------------------


@every
def test_only_losses_require_a_gradient(case: Case) -> None:
    for key, value in case.make()(case.batch()).items():
        assert value.requires_grad == key.startswith("loss_"), key


def by_forward(loss: Any, term: str, data: TensorDict) -> Tensor:
    return run(loss, data)[f"loss_{term}"]


def by_method(loss: Any, term: str, data: TensorDict) -> Tensor:
    torch.manual_seed(0)
    return getattr(loss, f"{term}_loss")(data)[0]


THROUGH = [
    pytest.param(case, through, id=f"{name}-{through.__name__}")
    for through, cases in ((by_forward, CASES), (by_method, OFFLINE))
    for name, case in cases.items()
]


@pytest.mark.parametrize(("case", "through"), THROUGH)
def test_a_term_sends_gradients_to_its_networks_alone(case: Case, through: Any) -> None:
    loss = case.make()
    for term, networks in case.trains.items():
        loss.zero_grad()
        through(loss, term, case.batch()).backward()
        assert reached(loss) == networks, term
        own = [g for name, g in gradients(loss).items() if name.split("_params.")[0] in networks]
        assert all(gradient.any() for gradient in own), term
    assert not any(p.requires_grad for name, p in loss.named_parameters() if name[:6] == "target")


def on_torso(
    case: Case, *, sharing: str = "all", **options: Any
) -> tuple[Any, nn.Linear, list[TensorDictModule]]:
    """A loss whose networks share a torso, the torso, and the networks.

    They are all of them, the critics alone, or all but the other critics than the first.
    """
    torch.manual_seed(7)
    torso = nn.Linear(OBSERVATION_DIM, OBSERVATION_DIM, dtype=torch.float64)
    networks = []

    def edit(module: TensorDictModule) -> TensorDictModule:
        known = [network.out_keys[-1] for network in networks]
        critic, first = module.out_keys[-1] in VALUES, module.out_keys[-1] not in known
        if {"all": True, "critics": critic, "first": first or not critic}[sharing]:
            network = OnTorso(torso, module.module)
            module = TensorDictModule(network, module.in_keys, module.out_keys)
        networks.append(module)
        return module

    return case.make(edit=edit, **options), torso, networks


@every_offline
@pytest.mark.parametrize("separate", [True, False])
def test_separate_losses_leave_a_shared_torso_to_the_generator(case: Case, separate: bool) -> None:
    loss, torso, _ = on_torso(case, separate_losses=separate)
    other, *_ = on_torso(case, separate_losses=not separate)
    assert same(run(loss, case.batch()), run(other, case.batch()))
    for term in case.trains:
        loss.zero_grad()
        by_method(loss, term, case.batch()).backward()
        moved = torso.weight.grad is not None and bool(torso.weight.grad.any())
        assert moved == (term == "generator" or not separate), term
        assert {*case.trains[term]} <= reached(loss) | {"generator"}


@every_offline
@pytest.mark.parametrize("separate", [True, False])
@pytest.mark.parametrize("sharing", ["all", "critics", "first"])
def test_shared_parameters_are_trained_once_for_all(
    case: Case, separate: bool, sharing: str
) -> None:
    options = {"separate_losses": separate, "sharing": sharing}
    loss, torso, networks = on_torso(case, **options)
    own = {id(p) for network in networks for p in network.parameters()}
    trained = [p for p in loss.parameters() if p.requires_grad]
    assert len(trained) == len({id(p) for p in trained}) == len(own)
    assert {id(p) for p in trained} == own
    before = torso.weight.detach().clone()
    total(loss(case.batch())).backward()
    torch.optim.SGD(trained, lr=1.0).step()
    assert not torch.equal(torso.weight, before)
    holders = {
        name
        for name, params in loss.named_children()
        if any(value is torso.weight for value in params.parameters())
    }
    readers = {name for names in case.trains.values() for name in names}
    assert holders == {f"{name}_params" for name in ({Q} if sharing == "critics" else readers)}
    fresh, *_ = on_torso(case, **options, seed=1)
    fresh.load_state_dict(loss.state_dict(), strict=True)
    assert same(run(fresh, case.batch()), run(loss, case.batch()))


@every_offline
def test_an_optimizer_leaves_the_targets_to_the_updater(case: Case) -> None:
    loss = case.make()
    updater = SoftUpdate(loss, tau=0.1)
    before = state(loss)
    total(loss(case.batch())).backward()
    torch.optim.Adam(loss.parameters(), lr=0.1).step()
    trained = state(loss)
    moved = {key.split("_params.")[0] for key in before if (before[key] != trained[key]).any()}
    assert moved == set().union(*case.trains.values())
    updater.step()
    after = state(loss)
    for key, value in trained.items():
        if key.startswith("target_"):
            value = 0.9 * value + 0.1 * trained[key.removeprefix("target_")]
            assert not torch.equal(after[key], before[key]) or not value.is_floating_point()
        torch.testing.assert_close(after[key], value)


@every_offline
def test_a_hard_update_copies_the_networks_at_its_interval(case: Case) -> None:
    loss = case.make()
    updater = HardUpdate(loss, value_network_update_interval=1)
    for parameter in loss.parameters():
        parameter.data.add_(1.0)

    def copied() -> set[bool]:
        children = dict(loss.named_children())
        names = [f"{name}_params" for name in case.targets]
        return {bool((children[f"target_{name}"] == children[name]).all()) for name in names}

    assert copied() == {False}
    updater.step()
    assert copied() == {False}
    updater.step()
    assert copied() == {True}


@every_student
def test_a_loss_without_targets_refuses_an_updater(case: Case) -> None:
    with pytest.raises(RuntimeError, match="target"):
        SoftUpdate(case.make(), tau=0.1)


# -- the critics -------------------------------------------------------------------------------


@every
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_loop_instead_of_vmap_changes_nothing(case: Case, device: str) -> None:
    results, grads = [], []  # on CPU the critics run in a loop anyway
    for deactivate_vmap in (False, True):
        loss = case.make(deactivate_vmap=deactivate_vmap).to(device)
        results.append(run(loss, case.batch().to(device)))
        total(results[-1]).backward()
        grads.append(gradients(loss))
    torch.testing.assert_close(*(r.detach().to_dict() for r in results), rtol=0, atol=1e-12)
    torch.testing.assert_close(*grads, rtol=0, atol=1e-12)


@every_offline
@pytest.mark.parametrize("number", [1, 2, 3])
def test_critics_of_a_list_keep_their_initialisations_and_are_trained(
    case: Case, number: int
) -> None:
    critics = critics_of(case, number)
    weights = [state(critic) for critic in critics]
    loss = case.make(critics=critics)
    assert loss.num_qvalue_nets == number
    for index, weight in enumerate(weights):
        params = loss.critic(index)[1].flatten_keys(".")
        assert all(torch.equal(params[key], value) for key, value in weight.items())
    value, info = loss.qvalue_loss(case.batch())
    assert info["td_error"].shape == (number, *case.shape)
    value.backward()
    own = [g for name, g in gradients(loss).items() if name.startswith(f"{Q}_params.")]
    assert len(own) >= len(weights[0])
    assert all(gradient.any() for gradient in own)


@every_offline
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("number", [1, 2])
def test_critics_compute_what_the_given_networks_do(case: Case, shared: bool, number: int) -> None:
    data = case.batch()
    if shared:
        loss, _, networks = on_torso(case, num_critics=number, separate_losses=True)
        critics = [module for module in networks if module.out_keys[-1] in VALUES]
    else:
        critics = critics_of(case, number)
        loss = case.make(critics=critics)
    key = critics[0].out_keys[-1]
    expected = torch.stack([critic(data.clone())[key] for critic in critics])
    assert torch.equal(loss.evaluate(data, key), expected)
    assert torch.equal(loss.evaluate(data, key, frozen=True), expected)
    assert not torch.equal(loss.evaluate(data, key, target=True), expected)
    for index, critic in enumerate(critics):
        module, params = loss.critic(index)
        with params.to_module(module, preserve_module_state=False):
            assert torch.equal(module(data.clone())[key], critic(data.clone())[key])


@every_offline
def test_a_single_critic_is_copied_with_new_initialisations(case: Case) -> None:
    (critic,) = critics_of(case, 1)
    given = state(critic)
    loss = case.make(critics=critic, num_qvalue_nets=3)
    weights = [loss.critic(index)[1].flatten_keys(".").data for index in range(3)]
    assert all(torch.equal(weights[0][key], value) for key, value in given.items())
    for key in (key for key in given if key.endswith("weight")):
        assert len(torch.stack([weight[key] for weight in weights]).unique(dim=0)) == 3
    assert loss.qvalue_loss(case.batch())[1]["td_error"].shape == (3, *case.shape)


@every_offline
def test_critics_that_cannot_be_taken_are_refused(case: Case) -> None:
    critics = critics_of(case, 2)
    with pytest.raises(BMRLError, match=r"list of 0 critics.*valid: at least one critic"):
        case.make(critics=[])
    with pytest.raises(BMRLError, match=r"2 critics and num_qvalue_nets is 3; valid: .*number"):
        case.make(critics=critics, num_qvalue_nets=3)
    with pytest.raises(BMRLError, match="num_qvalue_nets is 0; valid: at least 1"):
        case.make(critics=critics[0], num_qvalue_nets=0)
    critics[0].module.factor = nn.Parameter(torch.ones(1))
    with pytest.raises(BMRLError, match=r"MLP, has no reset_parameters.*valid: a list"):
        case.make(critics=critics[0], num_qvalue_nets=2)


def with_dropout(module: TensorDictModule) -> TensorDictModule:
    if module.out_keys[-1] not in VALUES:
        return module
    return TensorDictModule(Dropped(module.module), module.in_keys, module.out_keys)


@every
@pytest.mark.parametrize("randomness", [None, "different", "same"])
def test_critics_may_hold_dropout(case: Case, randomness: str | None) -> None:
    loss, plain = case.make(edit=with_dropout), case.make()
    if randomness is not None:
        loss.set_vmap_randomness(randomness)
    losses = run(loss, case.batch())
    assert not torch.equal(losses["loss_qvalue"], run(plain, case.batch())["loss_qvalue"])
    total(losses).backward()


# -- value estimators --------------------------------------------------------------------------

TD = ValueEstimators
ESTIMATORS = [(None, 0.0), (TD.TD0, 0.0), (TD.TD1, 1.0), (TD.TDLambda, 0.8)]
GAMMA = 0.99  # not exact in float32


def next_values(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def lambda_return(data: TensorDict, value: Tensor, lmbda: float) -> np.ndarray:
    """Backward recursion over the last dimension; an episode's end takes the bootstrap alone."""
    reward, done, terminated = (
        data["next", key].squeeze(-1).numpy() for key in ("reward", "done", "terminated")
    )
    value = value.numpy()
    result = np.zeros_like(reward)
    after = value[:, -1]
    for t in reversed(range(reward.shape[1])):
        mixed = (1 - lmbda) * value[:, t] + lmbda * after
        bootstrap = np.where(done[:, t], value[:, t], mixed)
        result[:, t] = after = reward[:, t] + GAMMA * (1 - terminated[:, t]) * bootstrap
    return result


@every_offline
@pytest.mark.parametrize(("estimator", "lmbda"), ESTIMATORS)
def test_target_is_that_of_the_estimator(case: Case, estimator: TD | None, lmbda: float) -> None:
    data, value = case.batch(3, 5), next_values(3, 5)
    loss = case.make(gamma=GAMMA if estimator is None else 0.5)
    if estimator is not None:
        options = {"lmbda": lmbda} if estimator is TD.TDLambda else {}
        assert loss.make_value_estimator(estimator, gamma=GAMMA, **options) is loss
    assert loss.value_estimator.gamma.item() == GAMMA
    target = loss.td_target(data, value.clone().requires_grad_())
    assert not target.requires_grad
    np.testing.assert_allclose(target, lambda_return(data, value, lmbda), rtol=1e-12)
    total(loss(data)).backward()


@every_offline
@pytest.mark.parametrize("instance", [False, True])
def test_an_estimator_of_the_user_gives_the_target(case: Case, instance: bool) -> None:
    data, value = case.batch(), next_values(8)
    expected = case.make(gamma=0.5).td_target(data, value)
    loss, options = case.make(gamma=0.1), {"gamma": 0.5, "value_network": None}
    if instance:
        assert loss.make_value_estimator(TD0Estimator(**options)) is loss
    else:
        assert loss.make_value_estimator(TD0Estimator, **options) is loss
    assert torch.equal(loss.td_target(data, value), expected)


@every_offline
def test_an_estimator_of_the_user_reads_the_renamed_keys(case: Case) -> None:
    loss = case.make()
    loss.set_keys(reward="prize")
    loss.make_value_estimator(TDLambdaEstimator(gamma=GAMMA, lmbda=0.8, value_network=None))
    assert loss.value_estimator.tensor_keys.reward == "prize"
    loss.set_keys(reward="score")
    assert loss.value_estimator.tensor_keys.reward == "score"


@every_offline
def test_n_step_data_bootstrap_with_the_discount_of_their_steps(case: Case) -> None:
    data, value = case.batch(), next_values(8)
    expected = case.make(gamma=GAMMA**3).td_target(data, value)
    data["steps_to_next_obs"] = torch.full((8, 1), 3)
    torch.testing.assert_close(case.make(gamma=GAMMA).td_target(data, value), expected)
    # TorchRL's own transform, along an episode without an end.
    data, value = case.batch(1, 6), next_values(1, 6)
    for key in ("done", "terminated", "truncated"):
        data["next", key].zero_()
    reward = data["next", "reward"].flatten()
    steps = MultiStep(gamma=GAMMA, n_steps=3)(data.clone())
    target = case.make(gamma=GAMMA).td_target(steps, value).flatten()
    n = steps["steps_to_next_obs"].flatten().tolist()
    for t in range(6):
        rewards = sum(GAMMA**i * reward[t + i] for i in range(n[t]))
        torch.testing.assert_close(target[t], rewards + GAMMA ** n[t] * value[0, t])
    assert n[:3] == [3, 3, 3]
    total(case.make()(steps)).backward()


@every
def test_estimators_that_make_no_sense_are_refused(case: Case) -> None:
    message = r"TD0.*TD1.*TDLambda" if case.offline else None  # the valid ones, or there is none
    with pytest.raises(NotImplementedError, match=message):
        case.make().make_value_estimator(TD.GAE if case.offline else TD.TD0)


# -- state, copies, dtype, device --------------------------------------------------------------


@every
def test_state_dict_is_the_same_after_use_and_loads_strictly_both_ways(case: Case) -> None:
    fresh, used = case.make(), case.make(seed=1)
    before = state(used)
    losses = run(used, case.batch())
    total(losses).backward()
    assert list(used.state_dict()) == list(before)
    assert not torch.equal(run(fresh, case.batch())["loss_qvalue"], losses["loss_qvalue"])
    case.make(seed=2).load_state_dict(used.state_dict(), strict=True)  # from used into fresh
    used.load_state_dict(case.make(seed=2).state_dict(), strict=True)  # and back
    fresh = case.make(seed=3)
    fresh.load_state_dict(used.state_dict(), strict=True)
    assert all(torch.equal(value, used.state_dict()[key]) for key, value in state(fresh).items())
    assert same(run(fresh, case.batch()), run(used, case.batch()))


def pickled(loss: LossModule) -> Any:
    return pickle.loads(pickle.dumps(loss))


@every
@pytest.mark.parametrize("copy", [deepcopy, pickled])
@pytest.mark.parametrize("used", [False, True])
def test_copies_give_the_same_losses_and_are_independent(
    case: Case, copy: Callable[[Any], Any], used: bool
) -> None:
    loss = case.make()
    if used:
        loss(case.batch())
    twin = copy(loss)
    assert same(run(loss, case.batch()), run(twin, case.batch()))
    before = state(loss)
    total(twin(case.batch())).backward()
    torch.optim.SGD(twin.parameters(), lr=1.0).step()
    assert all(parameter.grad is None for parameter in loss.parameters())
    assert all(torch.equal(value, before[key]) for key, value in state(loss).items())
    assert any(not torch.equal(value, before[key]) for key, value in state(twin).items())


@every
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("moved", [False, True])
def test_losses_have_the_dtype_of_networks_and_data(
    case: Case, dtype: torch.dtype, moved: bool
) -> None:
    other = torch.float32 if dtype == torch.float64 else torch.float64
    loss = case.make(dtype=other).to(dtype) if moved else case.make(dtype=dtype)
    data = case.batch(dtype=dtype)
    losses = loss(data)
    assert {value.dtype for value in (*losses.values(), data["td_error"])} == {dtype}
    total(losses).backward()
    assert {p.grad.dtype for p in loss.parameters() if p.grad is not None} == {dtype}
    assert not {other} & {value.dtype for value in loss.state_dict().values()}


@every_offline
def test_nested_batch_dimensions_are_rows_like_others(case: Case) -> None:
    loss = case.make(reduction="none")
    data = case.batch(2, 4)
    flat = data.clone().reshape(8)
    nested, rows = run(loss, data), run(loss, flat)
    assert torch.equal(data["td_error"].flatten(), flat["td_error"])
    for term in case.trains:
        assert nested[f"loss_{term}"].shape == (2, 4)
        torch.testing.assert_close(nested[f"loss_{term}"].flatten(), rows[f"loss_{term}"])


# Terms that need not fall: -Q follows the critics, and the penalty on m pays for the other terms.
RESTLESS = {"perturbation", "actor", "latent_norm"}


@every
def test_training_lowers_the_losses_on_one_batch(case: Case) -> None:
    torch.manual_seed(0)
    loss, data = case.make(), case.batch()
    updater = SoftUpdate(loss, tau=0.02) if case.targets else None
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    history = []
    for _ in range(60):
        losses = loss(data)
        optimizer.zero_grad()
        total(losses).backward()
        optimizer.step()
        if updater is not None:
            updater.step()
        history.append(losses.detach())
    for term in case.trains.keys() - RESTLESS:
        first, last = (
            torch.stack([losses[f"loss_{term}"] for losses in part]).mean()
            for part in (history[:5], history[-5:])
        )
        assert last < 0.8 * first, term


@pytest.mark.gpu
@every
def test_a_loss_moves_to_the_gpu(case: Case) -> None:
    loss, data = case.make().to("cuda"), case.batch().to("cuda")
    losses = loss(data)
    total(losses).backward()
    assert {value.device.type for value in (*losses.values(), data["td_error"])} == {"cuda"}
    assert all(value.isfinite().all() for value in losses.values())
    assert reached(loss) == set().union(*case.trains.values())


@pytest.mark.gpu
def test_losses_on_the_gpu_are_those_on_the_cpu() -> None:
    # The loss that draws nothing, so that both see the same numbers.
    case = CASES["discrete_bcq"]
    expected = case.make()(case.batch())
    losses = case.make().to("cuda")(case.batch().to("cuda")).cpu()
    torch.testing.assert_close(losses.to_dict(), expected.to_dict(), rtol=0, atol=1e-4)


@pytest.mark.gpu
@every
def test_an_update_replayed_as_a_cuda_graph_is_the_update(case: Case) -> None:
    results = []
    for graphed in (False, True):
        loss = case.make().to("cuda")
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, capturable=True)

        def update(data: TensorDict, loss: Any = loss, optimizer: Any = optimizer) -> TensorDict:
            optimizer.zero_grad(set_to_none=False)
            losses = loss(data)
            total(losses).backward()
            optimizer.step()
            return losses.detach()

        data = case.batch().to("cuda")
        torch.cuda.manual_seed(0)
        step = CudaGraphModule(update, in_keys=[], out_keys=[], warmup=5) if graphed else update
        history = [step(data.clone())["loss_qvalue"].item() for _ in range(20)]
        results.append(history)
    assert len(set(results[1][10:])) == 10
    # Capturing draws and updates once more, so that the two are close, not equal.
    assert np.mean(results[1][-5:]) == pytest.approx(np.mean(results[0][-5:]), rel=0.5)


# -- torch.compile -----------------------------------------------------------------------------


def check_compiled(case: Case, **options: Any) -> None:
    """No graph break, the same values and gradients, and one compilation for two batches."""
    torch._dynamo.reset()
    loss, data, other = case.make(), case.batch(), case.batch()
    expected = run(loss, data)
    total(expected).backward()
    expected_gradients = gradients(loss)
    loss.zero_grad()
    compiled = torch.compile(loss, fullgraph=True, **options)
    losses = run(compiled, other)
    total(losses).backward()
    torch.testing.assert_close(losses.detach().to_dict(), expected.detach().to_dict())
    torch.testing.assert_close(gradients(loss), expected_gradients)
    torch.testing.assert_close(other["td_error"], data["td_error"])
    with torch._dynamo.config.patch(error_on_recompile=True):
        compiled(case.batch())


@pytest.mark.slow
@every
def test_a_compiled_loss_has_no_graph_break_and_the_same_values(case: Case) -> None:
    check_compiled(case, backend="eager")  # draws as the uncompiled loss does


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no compiler")
def test_inductor_gives_the_same_values() -> None:
    with torch._inductor.config.patch(fallback_random=True):
        check_compiled(CASES["plas"])


# -- what is refused, before anything is written -----------------------------------------------


def refused(loss: LossModule, data: TensorDict, *words: str) -> None:
    """The loss names what is wrong, and has written nothing."""
    before = dict(data.items(True, True))
    with pytest.raises(BMRLError) as error:
        loss(data)
    for word in words:
        assert word in str(error.value)
    after = dict(data.items(True, True))
    assert after.keys() == before.keys()
    assert all(after[key] is value for key, value in before.items())


def wider(value: Tensor) -> Tensor:
    return torch.cat([value, value[..., :1]], -1)


def flat(value: Tensor) -> Tensor:
    return value.squeeze(-1)


@every_offline
@pytest.mark.parametrize("key", ["reward", "done", "terminated"])
@pytest.mark.parametrize("change", [wider, flat])
def test_rewards_and_flags_of_another_shape_are_refused(
    case: Case, key: str, change: Callable[[Tensor], Tensor]
) -> None:
    data = case.batch()
    data["next", key] = value = change(data["next", key])
    refused(case.make(), data, repr(("next", key)), str(tuple(value.shape)), "valid: (8, 1)")


@every
def test_actions_of_another_size_are_refused(case: Case) -> None:
    data = case.batch()
    categorical = data["action"].ndim == len(case.shape)
    data["action"] = value = data["action"].repeat(2, 1).T if categorical else wider(data["action"])
    refused(case.make(), data, "'action'", str(tuple(value.shape)), "valid")


@every_offline
def test_next_observations_of_another_batch_are_refused(case: Case) -> None:
    loss, data = case.make(), case.batch()
    keywords = as_keywords(data, loss.in_keys)
    keywords["next_observation"] = keywords["next_observation"][:7]
    with pytest.raises(BMRLError, match=r"\('next', 'observation'\).*\(7, 3\); valid: \(8,\)"):
        loss(**keywords)


@every_student
@pytest.mark.parametrize("shape", [(5,), (4, 5), (3, 5, 1)])
def test_batches_that_are_not_one_row_per_teacher_are_refused(
    case: Case, shape: tuple[int, ...]
) -> None:
    data = TensorDict({"observation": torch.zeros(*shape, 3)}, batch_size=shape)
    refused(case.make(), data, str(list(shape)), "valid: [3, B], one row per teacher")


@every_student
@pytest.mark.parametrize(
    ("key", "shape"),
    [("task", (3, 5, 1)), (("next", "reward"), (3, 5)), (("next", "reward"), (3, 5, 2))],
)
def test_tasks_and_rewards_of_another_shape_are_refused(
    case: Case, key: Any, shape: tuple[int, ...]
) -> None:
    data = case.batch()
    data[key] = torch.zeros(shape, dtype=data[key].dtype)
    refused(case.make(), data, repr(key), str(shape), "valid")


@every
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_refused(case: Case, bad: float) -> None:
    loss = case.make()
    for key in (key for key in loss.in_keys if case.batch()[key].is_floating_point()):
        data = case.batch()
        data[key][-1, ..., -1] = bad
        refused(loss, data, repr(key), f"{bad}", "valid: finite numbers")


SPEC = Bounded(low=torch.tensor([-1.0, -2.0]), high=torch.tensor([0.5, 3.0]), shape=(2,))
VAE = ("bcq", "plas")
BAD_OPTIONS = [
    (CASES, {"reduction": "avg"}, "'avg'; valid .*: mean, sum, none"),
    (OFFLINE, {"loss_function": "huber"}, "'huber'; valid .*: l2, l1, smooth_l1"),
    (VAE, {"lmbda": 1.5}, "lmbda is 1.5; valid: between 0 and 1"),
    (VAE, {"lmbda": -0.1}, "lmbda is -0.1; valid: between 0 and 1"),
    (VAE, {"kl_reduction": "max"}, "'max'; valid .*: mean, sum"),
    (VAE, {"bounds": None}, "either action_spec or bounds; got neither"),
    (VAE, {"action_spec": SPEC}, "either action_spec or bounds; got both"),
    (VAE, {"bounds": (1.0, -1.0)}, "lower bound .*1.* above the upper bound .*-1"),
    (VAE, {"bounds": None, "action_spec": Unbounded((2,))}, "Unbounded.*; valid: Bounded"),
    (["bcq"], {"num_candidates": 0}, "num_candidates is 0; valid: at least 1"),
    (["bcq"], {"value_bounds": (1.0, 0.0)}, r"value_bounds are \(1.0, 0.0\); valid: \(low, high"),
    (["discrete_bcq"], {"threshold": 1.5}, "threshold is 1.5; valid: between 0 and 1"),
    (["discrete_bcq"], {"action_space": "box"}, "'box'; valid .*: one-hot, categorical"),
    (STUDENTS, {"context": "next"}, "'next'; valid .*: current, previous, random, set"),
    (STUDENTS, {"context_fraction": 1.5}, "context_fraction is 1.5; valid: between 0 and 1"),
    (STUDENTS, {"context_size": 0}, "context_size is 0; valid: at least 1"),
    (STUDENTS, {"encoder_terms": ("norm",)}, "'norm'; valid .*: classification, .*metric"),
]


@pytest.mark.parametrize(
    ("case", "options", "message"),
    [
        pytest.param(CASES[name], options, message, id=f"{name}-{'-'.join(options)}")
        for names, options, message in BAD_OPTIONS
        for name in names
    ],
)
def test_bad_options_are_refused_with_the_valid_ones(
    case: Case, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(BMRLError, match=message):
        case.make(**options)


@pytest.mark.parametrize("name", VAE)
@pytest.mark.parametrize("part", ["encoder", "decoder", "latent_dim"])
def test_a_generator_that_lacks_a_part_is_refused_by_name(name: str, part: str) -> None:
    loss = CASES[name].make()
    generator = deepcopy(loss.generator)
    delattr(generator, part)
    networks = [generator, *([loss.actor_network] if name == "plas" else []), loss.qvalue_network]
    with pytest.raises(BMRLError, match=f"no {part!r}; valid: .*{re.escape('ActionVAE')}"):
        type(loss)(*networks, bounds=(-1.0, 1.0))
