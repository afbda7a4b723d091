"""The distillation with an encoder of sets, without a classifier, and terms that compare tasks."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import (
    CELLS,
    DIMS,
    LATENT_DIM,
    TASK_LATENT_DIM,
    TASKS,
    distillation_networks,
    reached,
    run,
    set_networks,
    set_transitions,
    task_transitions,
    total,
)
from recomputed import recorded
from tensordict import TensorDict, unravel_key
from tensordict.nn import TensorDictModule

from torchrl_bmrl.contrast import contrastive_error, distance_error
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import triplet_error
from torchrl_bmrl.modules import as_context, make_context_encoder, make_told_encoder
from torchrl_bmrl.objectives import MetaDistillationLoss
from torchrl_bmrl.objectives.student_terms import arranging_errors

GIVEN = {"context": "given"}
each_context = pytest.mark.parametrize("context", ["set", "given"])
ROWS, SIZE = 8, 2
TERMS = ("classification", "generator", "direction", "qvalue", "metric")
ARRANGING = {"metric_weight": 0.5, "distance_weight": 0.3, "contrastive_weight": 0.2}


def make_loss(pooling: str = "attention", classifies: bool = True, **options: Any) -> Any:
    torch.manual_seed(0)
    networks = set_networks(pooling)
    if not classifies:
        networks["task_classifier"] = None
    defaults = {"context": "set", "context_fraction": 1.0, "context_size": SIZE}
    return MetaDistillationLoss(**networks, latent_dim=LATENT_DIM, **(defaults | options))


def batch(rows: int = ROWS) -> TensorDict:
    return set_transitions(TASKS, rows)


# -- which context ---------------------------------------------------------------------------------


def used(loss: Any, data: TensorDict) -> tuple[Any, torch.Tensor, torch.Tensor]:
    """Inputs and outputs of the encoder, and m of each row."""
    calls = recorded(loss.task_encoder.module)
    latent = loss.embed(data)
    inputs, points = calls[-1]
    return inputs, points, latent


def test_a_row_is_never_in_the_set_that_its_m_is_of() -> None:
    loss, data = make_loss(), batch()
    for seed in range(20):
        torch.manual_seed(seed)
        inputs, points, latent = used(loss, data)
        observation = inputs[0]
        for task in range(TASKS):
            for row in range(ROWS):
                (number,) = (points[task] == latent[task, row]).all(-1).nonzero()[0]
                members = observation[task, number]
                assert not (members == data["observation"][task, row]).all(-1).any()
                # ... and it is one of the row's own task.
                own = data["observation"][task]
                assert all((own == member).all(-1).any() for member in members)


def test_given_contexts_are_those_under_the_key_and_no_others() -> None:
    loss, data = make_loss(**GIVEN), batch()
    inputs, *_ = used(loss, data)
    given = data["context", "observation"]
    for task in range(TASKS):
        for member in inputs[0][task].flatten(0, 1):
            assert (given[task] == member).all(-1).any()


@each_context
def test_keys_are_those_that_are_read(context: str) -> None:
    loss, data = make_loss(context=context), batch()
    under = [key for key in loss.in_keys if isinstance(key, tuple) and key[0] == "context"]
    assert bool(under) == (context == "given")
    assert not any("mask" in key for key in loss.in_keys)
    expected = run(loss, data)
    assert (run(loss, data.select(*loss.in_keys)) == expected).all()
    assert list(loss.out_keys) == list(expected.keys())


def test_data_without_contexts_are_refused_by_name() -> None:
    with pytest.raises(BMRLError, match="context"):
        make_loss(**GIVEN)(batch().exclude("context"))


@pytest.mark.parametrize(("context", "key"), [("set", ()), ("given", "context")])
@pytest.mark.parametrize(
    ("part", "shape"), [("action", (3, 8, 9)), (("next", "reward"), (3, 8)), ("mask", None)]
)
def test_rows_of_another_size_are_named(context: str, key: Any, part: Any, shape: Any) -> None:
    data = batch()
    if shape is None:  # what is called mask in the data is none of the loss's business
        data[unravel_key((key, "mask"))] = torch.zeros(3, 8, 2)
        make_loss(context=context)(data)
        return
    full = unravel_key((key, part))
    data[full] = torch.zeros(shape).double()
    with pytest.raises(BMRLError) as error:
        make_loss(context=context)(data)
    assert repr(full) in str(error.value)
    assert str(shape) in str(error.value)


def test_an_encoder_may_have_names_of_its_own() -> None:
    loss, names = make_loss(), {("context", "observation"): ("context", "agent", "seen")}
    networks = set_networks()
    own = networks["task_encoder"]
    keys = [names.get(each, each) for each in own.in_keys]
    networks["task_encoder"] = TensorDictModule(own.module, keys, ["task_latent"])
    other = MetaDistillationLoss(
        **networks, latent_dim=LATENT_DIM, context="set", context_fraction=1.0, context_size=SIZE
    )
    other.load_state_dict(loss.state_dict())
    data = batch()
    expected = run(loss, data)
    data["agent"] = TensorDict({"seen": data["observation"].clone()}, data.batch_size)
    assert ("agent", "seen") in other.in_keys
    assert (run(other, data) == expected).all()


def test_the_context_of_another_task_changes_no_row() -> None:
    loss, data = make_loss(**GIVEN), batch()
    torch.manual_seed(1)
    before = loss.embed(data)
    data["context", "observation"][2] += 1
    torch.manual_seed(1)
    after = loss.embed(data)
    assert torch.equal(after[:2], before[:2])
    assert not torch.equal(after[2], before[2])


def test_a_batch_for_less_than_two_contexts_is_refused() -> None:
    with pytest.raises(BMRLError, match=r"3 rows .*context_size is 2; valid"):
        make_loss()(batch(3))


# -- the terms -------------------------------------------------------------------------------------


def test_arranging_terms_are_those_of_the_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    from torchrl_bmrl.objectives import student_terms

    loss, drawn = make_loss(**ARRANGING, reduction="none", temperature=0.3), []
    original = student_terms.draw_others

    def record(points: Any, valid: Any) -> Any:
        drawn.append((points, *original(points, valid)))
        return drawn[-1][1:]

    monkeypatch.setattr(student_terms, "draw_others", record)
    losses = loss(batch())
    ((points, near, far),) = drawn
    assert points.shape == (TASKS, ROWS // SIZE, TASK_LATENT_DIM)
    expected = {
        "metric": 0.5 * triplet_error(points, near, far, 1.0),
        "distance": 0.3 * distance_error(points, near, far),
        "contrastive": 0.2 * contrastive_error(points, near, 0.3),
    }
    for term, error in expected.items():
        each = losses[f"loss_{term}"]
        assert each.shape == (TASKS, ROWS)
        torch.testing.assert_close(each, error.mean(1, keepdim=True).expand(TASKS, ROWS))


@pytest.mark.parametrize("reduction", ["none", "sum", "mean"])
def test_reductions_agree_and_weights_multiply(reduction: str) -> None:
    def losses(reduction: str, factor: float = 1.0) -> TensorDict:
        weights = {name: factor * weight for name, weight in ARRANGING.items()}
        return run(make_loss(**weights, reduction=reduction), batch())

    reduce = {"none": lambda x: x, "sum": torch.sum, "mean": torch.mean}[reduction]
    once, rows, thrice = losses(reduction), losses("none"), losses(reduction, 3.0)
    for term in ("metric", "distance", "contrastive"):
        key = f"loss_{term}"
        torch.testing.assert_close(once[key], reduce(rows[key]))
        torch.testing.assert_close(thrice[key], 3 * once[key])


@pytest.mark.parametrize("sets", [True, False])
@pytest.mark.parametrize("terms", [(), *((term,) for term in TERMS), TERMS], ids="-".join)
def test_the_chosen_terms_alone_train_the_encoder(sets: bool, terms: tuple[str, ...]) -> None:
    own = {
        "classification": {"task_classifier"},
        "generator": {"student_generator"},
        "direction": {"student_generator"},
        "qvalue": {"student_qvalue_network"},
        "metric": set(),
        "distance": set(),
        "contrastive": set(),
        "latent_norm": set(),
    }
    if sets:
        loss = make_loss(**ARRANGING, encoder_terms=terms)
    else:
        networks = distillation_networks()
        options = {"context": "current", "encoder_terms": terms}
        loss = MetaDistillationLoss(**networks, latent_dim=LATENT_DIM, **options, **ARRANGING)
    chosen = {*terms, "latent_norm", *(("distance", "contrastive") if "metric" in terms else ())}
    for term, networks in own.items():
        trained = {"task_encoder"} if term in chosen else set()
        loss.zero_grad()
        value = run(loss, batch())[f"loss_{term}"]
        if value.requires_grad:
            value.backward()
        assert reached(loss) == networks | trained, term


@each_context
def test_without_a_classifier_there_is_no_term_no_accuracy_and_no_parameter(context: str) -> None:
    loss = make_loss(classifies=False, context=context)
    losses = loss(batch())
    assert not {"loss_classification", "accuracy"} & set(losses.keys())
    assert not any("classifier" in name for name, _ in loss.named_parameters())
    assert list(loss.out_keys) == list(losses.keys())
    with_classifier = make_loss(context=context)
    torch.manual_seed(5)
    expected = with_classifier(batch())
    torch.manual_seed(5)
    found = loss(batch())
    for key, value in found.items():
        assert torch.equal(value, expected[key]), key


def test_learning_arranges_the_tasks() -> None:
    loss = make_loss("mean", contrastive_weight=1.0, distance_weight=0.1)
    data = batch(32)
    for part in (data, data["context"]):  # tasks that differ in their rewards
        part["next", "reward"] += 2 * torch.arange(TASKS).view(-1, 1, 1)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    first = loss(data).detach()
    for _ in range(100):
        optimizer.zero_grad()
        total(loss(data)).backward()
        optimizer.step()
    last = loss(data).detach()
    for term in ("contrastive", "distance", "classification"):
        assert last[f"loss_{term}"] < 0.7 * first[f"loss_{term}"], term


# -- padding ---------------------------------------------------------------------------------------


def padded(data: TensorDict, mask: torch.Tensor, value: float) -> TensorDict:
    data = data.clone()
    for key, entry in list(data.items(True, True)):
        if entry.is_floating_point():
            data[key] = entry.masked_fill(~mask.unsqueeze(-1), value)
    return data.set(("collector", "mask"), mask.unsqueeze(-1))


@each_context
@pytest.mark.parametrize("number", [0, 1, 3])
def test_padding_changes_no_loss_whatever_it_holds(context: str, number: int) -> None:
    torch.manual_seed(number)
    mask = torch.rand(TASKS, ROWS) < 0.4
    mask[:, number] = True
    results = []
    for value in (0.0, 7.0, float("nan")):
        loss = make_loss(context=context, **ARRANGING)
        losses = run(loss, padded(batch(), mask, value), seed=number)
        total(losses).backward()
        gradients = [p.grad for p in loss.parameters() if p.grad is not None]
        results.append((losses, gradients))
    for losses, gradients in results[1:]:
        for key, found in losses.items():
            torch.testing.assert_close(found, results[0][0][key], msg=key)
        for found, expected in zip(gradients, results[0][1], strict=True):
            torch.testing.assert_close(found, expected)


def test_a_task_of_padding_alone_moves_m_of_no_other_task() -> None:
    valid = torch.ones(TASKS, ROWS, dtype=torch.bool)
    valid[1], points, found = False, torch.randn(TASKS, ROWS, 2), []
    for _ in range(2):
        torch.manual_seed(0)
        errors = arranging_errors(make_loss(**ARRANGING), points, valid, valid.shape)
        found.append(torch.stack([error[0] for error in errors.values()]))
        points[1] += torch.randn(2)
    assert torch.equal(*found)


def test_m_of_a_row_that_counts_is_never_that_of_padding() -> None:
    mask = torch.zeros(TASKS, ROWS, dtype=torch.bool)
    mask[:, :3] = True
    loss = make_loss()
    nothing = {key: torch.zeros(1, 1, n).double() for key, n in (("observation", 3), ("action", 2))}
    nothing["next"] = {"observation": torch.zeros(1, 1, 3), "reward": torch.zeros(1, 1, 1)}
    empty = loss.call("task_encoder", as_context(TensorDict(nothing, [1, 1]).double()))
    for seed in range(30):
        torch.manual_seed(seed)
        latent = loss.embed(padded(batch(), mask, 0.0))[mask]
        assert not torch.isclose(latent, empty["task_latent"], rtol=1e-9).all(-1).any()


def test_a_mask_of_all_rows_gives_finite_losses_as_none_does() -> None:
    data = padded(batch(), torch.ones(TASKS, ROWS, dtype=torch.bool), 0.0)
    assert make_loss(**ARRANGING)(data).isfinite().all()
    empty = padded(batch(), torch.zeros(TASKS, ROWS, dtype=torch.bool), float("nan"))
    assert make_loss(**ARRANGING)(empty).isfinite().all()


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"context": "current"}, "context is current.*valid: set or given"),
        ({"context": "previous"}, "context is previous.*valid: set or given"),
        ({"context": "random"}, "context is random.*valid: set or given"),
        ({"context": "episode"}, "'episode'; valid .*given"),
        ({"context_fraction": 0.5}, "context_fraction is 0.5.*valid: 1"),
        ({"isometry_weight": 1.0}, "isometry_weight is 1.0.*valid: 0"),
        ({"temperature": 0.0}, "temperature is 0"),
        ({"distance_weight": -1.0}, "distance_weight is -1.0"),
        ({"contrastive_weight": float("nan")}, "contrastive_weight is nan"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: dict[str, Any], says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        make_loss(**options)


def test_terms_that_compare_tasks_need_two() -> None:
    for name in ARRANGING:
        with pytest.raises(BMRLError, match=f"{name}.*at least two tasks"):
            MetaDistillationLoss(
                **set_networks(num_tasks=1),
                latent_dim=LATENT_DIM,
                context="set",
                context_fraction=1.0,
                **{name: 1.0},
            )


def test_single_transitions_have_no_given_context() -> None:
    with pytest.raises(BMRLError, match="context is given; valid with an encoder of sets"):
        MetaDistillationLoss(**distillation_networks(), latent_dim=LATENT_DIM, context="given")


def test_a_term_that_is_no_term_of_the_encoder_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"'distance'; valid .*metric"):
        make_loss(encoder_terms=("distance",))


# -- told, names, and states ----------------------------------------------------------------------


def test_an_encoder_that_is_told_the_task_has_no_parameters_and_learns_nothing() -> None:
    codes = torch.tensor([[0.0, 1.0], [1.0, 0.0], [-1.0, 0.5]]).double()
    networks = distillation_networks() | {"task_encoder": make_told_encoder(codes)}
    networks["task_classifier"] = None
    loss = MetaDistillationLoss(**networks, latent_dim=LATENT_DIM, context="current")
    data = task_transitions()
    expected = codes.unsqueeze(1).expand(TASKS, data.shape[1], 2)
    assert torch.equal(loss.embed(data), expected)
    total(loss(data)).backward()
    assert reached(loss) == {"student_generator", "student_qvalue_network"}


@each_context
def test_a_state_goes_through_a_state_dict(context: str) -> None:
    loss, other = make_loss(context=context), make_loss(context=context)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter += 0.1
    other.load_state_dict(loss.state_dict())
    assert (run(other, batch()) == run(loss, batch())).all()


def test_an_encoder_of_another_type_is_that_of_the_whole_loss() -> None:
    encoder = make_context_encoder(*DIMS, TASK_LATENT_DIM, num_cells=CELLS, num_features=4).double()
    loss = MetaDistillationLoss(
        **(set_networks() | {"task_encoder": encoder}),
        latent_dim=LATENT_DIM,
        context="set",
        context_fraction=1.0,
        context_size=SIZE,
    )
    assert all(value.dtype == torch.float64 for value in loss(batch()).values())
