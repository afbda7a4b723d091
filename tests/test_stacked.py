"""Members of a stack are trained as they would be alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import NO_UPDATER, make_bcq_loss, transitions
from tensordict import TensorDict
from test_loss_contract import CASES, Case, every, every_offline
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate, ValueEstimators

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import OfflineLoss, StackedLoss
from torchrl_bmrl.testing.wrappers import with_dropout
from torchrl_bmrl.training import gradient_step, make_adam

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
MEMBERS, TAU, LR = 3, 0.1, 2**-7  # which every type holds exactly
vmap_or_loop = pytest.mark.parametrize("deactivate_vmap", [False, True], ids=["vmap", "loop"])


@pytest.fixture
def same_noise(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Draws that depend on an update's number and their shape alone, whoever makes them."""
    number = 0
    drawn = {name: getattr(torch, name) for name in ("randn", "rand", "randint", "randperm")}

    def draw(name: str, shape: Any, *args: Any, **options: Any) -> Tensor:
        if "generator" in options:  # data, not noise
            return drawn[name](*args, tuple(shape), **options)
        # Not torch's own: under vmap it would draw for each member.
        random = np.random.default_rng(abs(hash((number, tuple(shape)))))
        if name == "randint":
            return torch.from_numpy(random.integers(*args, size=tuple(shape)))
        options = {"dtype": options.get("dtype") or torch.get_default_dtype()}
        value = random.normal(size=tuple(shape)) if name == "randn" else random.random(tuple(shape))
        return torch.as_tensor(value).to(**options)

    def as_shape(args: tuple[Any, ...]) -> Any:
        return args[0] if len(args) == 1 and not isinstance(args[0], int) else args

    def randint(*args: Any, **options: Any) -> Tensor:
        *bounds, shape = args
        return draw("randint", shape, *bounds, **options)

    monkeypatch.setattr(torch, "randn", lambda *args, **o: draw("randn", as_shape(args), **o))
    monkeypatch.setattr(torch, "rand", lambda *args, **o: draw("rand", as_shape(args), **o))

    def randperm(count: int, **options: Any) -> Tensor:
        random = np.random.default_rng(number + count)
        return torch.from_numpy(random.permutation(count))

    monkeypatch.setattr(torch, "randint", randint)
    monkeypatch.setattr(torch, "randperm", randperm)
    monkeypatch.setattr(
        torch, "randn_like", lambda x: draw("randn", x.shape, dtype=x.dtype, device=x.device)
    )

    def start(update: int) -> None:
        nonlocal number
        number = update

    return start


def members(case: Case, **options: Any) -> list[LossModule]:
    return [case.make(seed=seed, **options) for seed in range(MEMBERS)]


def batches(case: Case, update: int) -> TensorDict:
    generator, rows = torch.Generator().manual_seed(update), []
    for _ in range(MEMBERS):
        row = case.batch()
        for key in ("observation", ("next", "observation"), ("next", "reward")):
            noise = torch.randn(row[key].shape, generator=generator)
            row[key] = row[key] + 0.3 * noise
        rows.append(row)
    return torch.stack(rows)


def terms(losses: TensorDict) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def train_alone(
    loss: LossModule, data: Callable[[int], TensorDict], noise: Any, count: int
) -> None:
    """As a user's own loop does it."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=LR)
    has_targets = any(name.startswith("target_") for name, _ in loss.named_children())
    targets = SoftUpdate(loss, tau=TAU) if has_targets else None
    for update in range(count):
        batch = data(update)
        noise(update)
        optimizer.zero_grad()
        terms(loss(batch)).backward()
        optimizer.step()
        if targets is not None:
            targets.step()


def assert_states_close(one: LossModule, other: LossModule) -> None:
    a, b = one.state_dict(), other.state_dict()
    assert a.keys() == b.keys()
    for key, value in a.items():
        torch.testing.assert_close(value, b[key], rtol=0, atol=1e-5)


@every
@vmap_or_loop
def test_every_member_equals_training_it_alone(
    case: Case, deactivate_vmap: bool, same_noise: Callable[[int], None]
) -> None:
    stack = StackedLoss(members(case), deactivate_vmap=deactivate_vmap)
    optimizer = make_adam(stack.parameters(), lr=LR)
    targets = SoftUpdate(stack, tau=TAU) if case.targets else None
    for update in range(50):
        batch = batches(case, update)
        same_noise(update)
        gradient_step(optimizer, terms(stack(batch)))
        if targets is not None:
            targets.step()
    starts = members(case)
    for i, alone in enumerate(members(case)):
        train_alone(alone, lambda update, i=i: batches(case, update)[i], same_noise, 50)
        assert_states_close(stack.member(i), alone)
        moved = [
            (value - starts[i].state_dict()[key]).abs().max()
            for key, value in alone.state_dict().items()
        ]
        assert max(moved) > 0.1  # the comparison is not one of beginnings


@every_offline
@vmap_or_loop
def test_loss_methods_metrics_and_priorities_are_the_members_own(
    case: Case, deactivate_vmap: bool, same_noise: Callable[[int], None]
) -> None:
    losses = members(case)
    stack = StackedLoss(losses, deactivate_vmap=deactivate_vmap)
    batch = batches(case, 0)
    for name in case.trains:
        same_noise(0)
        value, metrics = getattr(stack, f"{name}_loss")(batch)
        for i, loss in enumerate(losses):
            own, info = getattr(loss, f"{name}_loss")(batch[i])
            torch.testing.assert_close(value[i], own)
            assert metrics.keys() == info.keys()
            for key in info:
                torch.testing.assert_close(metrics[key][i], info[key])
    result = stack(batch)
    assert list(result.keys()) == losses[0].out_keys
    priority = losses[0].tensor_keys.priority
    for i, loss in enumerate(losses):
        row = batch[i].exclude(priority)
        loss(row)
        torch.testing.assert_close(batch[i][priority], row[priority])


@every_offline
def test_critics_under_vmap_within_a_stack_under_vmap_give_the_same(
    case: Case, same_noise: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for in_sequence in (True, False):  # as on a CPU, as on a GPU
        monkeypatch.setattr(OfflineLoss, "critics_in_sequence", in_sequence)
        stack = StackedLoss(members(case), deactivate_vmap=in_sequence)
        same_noise(0)
        value, metrics = stack.qvalue_loss(batches(case, 0))
        value.sum().backward()
        grads = {i: p.grad for i, p in enumerate(stack.qvalue_network_params.parameters())}
        results.append({"value": value} | metrics | grads)
    for key, value in results[0].items():
        torch.testing.assert_close(results[1][key], value)


@vmap_or_loop
def test_gradients_of_one_member_stay_with_it(deactivate_vmap: bool) -> None:
    stack = StackedLoss(members(CASES["bcq"]), deactivate_vmap=deactivate_vmap)
    value, _ = stack.qvalue_loss(batches(CASES["bcq"], 0))
    value[1].backward()
    for parameter in stack.qvalue_network_params.parameters():
        rows = parameter.grad.flatten(1).abs().sum(1)
        assert rows[1] > 0
        assert rows[0] == rows[2] == 0
    assert all(p.grad is None for p in stack.generator_params.parameters())


def test_eval_turns_the_dropout_of_all_members_off() -> None:
    made = [CASES["bcq"].make(edit=with_dropout) for _ in range(2)]
    stack, plain = (StackedLoss(x) for x in (made, [CASES["bcq"].make() for _ in range(2)]))
    data = torch.stack([CASES["bcq"].batch() for _ in range(2)])

    def values(loss: StackedLoss) -> Tensor:
        torch.manual_seed(0)
        return loss(data.clone())["loss_qvalue"]

    assert not torch.equal(values(stack), values(plain))
    assert torch.equal(values(stack.eval()), values(plain))


@vmap_or_loop
def test_members_draw_noise_of_their_own(deactivate_vmap: bool) -> None:
    stack = StackedLoss([make_bcq_loss() for _ in range(3)], deactivate_vmap=deactivate_vmap)
    row = CASES["bcq"].batch()
    values, _ = stack.qvalue_loss(torch.stack([row] * 3))
    assert len(set(values.tolist())) == 3


def test_members_keep_the_trace_of_their_own_estimator_when_an_option_is_assigned(
    same_noise: Callable[[int], None],
) -> None:
    losses = [make_bcq_loss(dtype=torch.float64) for _ in range(2)]
    for loss, lmbda in zip(losses, (0.1, 0.95), strict=True):
        loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.9, lmbda=lmbda)
    stack, data = StackedLoss(losses), transitions(3, 5)

    def check() -> None:
        same_noise(0)
        within = stack.qvalue_loss(torch.stack([data] * 2))[1]["target_value"]
        alone = [stack.member(i).qvalue_loss(data)[1]["target_value"] for i in range(2)]
        torch.testing.assert_close(within, torch.stack(alone))

    check()
    stack.reduction = "sum"
    check()
    stack.gamma = 0.5
    check()
    assert [float(stack.member(i).value_estimator.lmbda) for i in range(2)] == [0.1, 0.95]
    stack.make_value_estimator(ValueEstimators.TDLambda, gamma=0.9, lmbda=0.5)
    check()
    assert [float(stack.member(i).value_estimator.lmbda) for i in range(2)] == [0.5, 0.5]


@vmap_or_loop
def test_a_member_with_wrong_numbers_leaves_the_others_as_they_are(
    deactivate_vmap: bool, same_noise: Callable[[int], None]
) -> None:
    def trained(broken: bool) -> StackedLoss:
        same_noise(0)  # the targets of the members start with it
        losses = members(CASES["bcq"])
        if broken:
            next(losses[1].qvalue_network_params.parameters()).data.fill_(float("inf"))
        stack = StackedLoss(losses, deactivate_vmap=deactivate_vmap)
        optimizer = make_adam(stack.qvalue_network_params.parameters(), lr=LR)
        for update in range(3):
            batch = batches(CASES["bcq"], update)
            same_noise(update)
            gradient_step(optimizer, stack.qvalue_loss(batch)[0], max_norm=1.0)
        return stack

    broken, well = trained(True), trained(False)
    assert not all(x.isfinite().all() for x in broken.member(1).state_dict().values())
    for i in (0, 2):
        assert_states_close(broken.member(i), well.member(i))


@vmap_or_loop
def test_members_keep_coefficients_of_their_own(
    deactivate_vmap: bool, same_noise: Callable[[int], None]
) -> None:
    losses = [make_bcq_loss(kl_weight=weight) for weight in (0.0, 0.5)]
    losses[1].load_state_dict(
        losses[0].state_dict() | {"kl_weight": torch.tensor(0.5)}, strict=False
    )
    stack = StackedLoss(losses, deactivate_vmap=deactivate_vmap)
    row = transitions(8)
    same_noise(0)
    values, metrics = stack.generator_loss(torch.stack([row, row]))
    assert float((values[1] - values[0]).detach()) == pytest.approx(
        0.5 * float(metrics["kl_divergence"][0])
    )


def test_hard_update_copies_every_members_critics() -> None:
    stack = StackedLoss(members(CASES["bcq"]))
    updater = HardUpdate(stack, value_network_update_interval=1)
    with torch.no_grad():
        for parameter in stack.qvalue_network_params.parameters():
            parameter.add_(1.0)
    updater.step()
    updater.step()
    pairs = zip(
        stack.qvalue_network_params.values(True, True),
        stack.target_qvalue_network_params.values(True, True),
        strict=True,
    )
    assert all(torch.equal(source, target) for source, target in pairs)


def test_a_stack_follows_to_another_type_and_its_state_loads() -> None:
    stack = StackedLoss(members(CASES["bcq"])).float()
    assert {p.dtype for p in stack.parameters()} == {torch.float32}
    batch = torch.stack([transitions(8, dtype=torch.float32) for _ in range(MEMBERS)])
    assert stack.qvalue_loss(batch)[0].dtype == torch.float32
    other = StackedLoss(list(reversed(members(CASES["bcq"])))).float()
    other.load_state_dict(stack.state_dict())
    assert_states_close(other, stack)


@every
@vmap_or_loop
def test_masks_of_the_members_may_differ_and_hide_anything(
    case: Case, deactivate_vmap: bool, same_noise: Callable[[int], None]
) -> None:
    losses, batch = members(case), batches(case, 0)
    numbers = torch.arange(MEMBERS).view(-1, *[1] * len(case.shape))
    mask = (torch.arange(case.batch().numel()).view(case.shape) + numbers) % 3 > 0
    batch["collector", "mask"] = mask.unsqueeze(-1)
    for value in batch.values(True, True):
        if value.is_floating_point():
            value[~mask] = float("nan")
    stack = StackedLoss(losses, deactivate_vmap=deactivate_vmap)
    for index, loss in enumerate(losses):
        same_noise(0)
        alone = loss(row := batch[index].clone())
        assert (row["td_error"][~mask[index]] == 0).all()
        assert all(value.isfinite() for value in alone.values())
    same_noise(0)
    result = stack(batch)
    torch.testing.assert_close(batch["td_error"][-1], row["td_error"])
    for key in set(alone.keys()) - {f"loss_{term}" for term in case.trains}:
        torch.testing.assert_close(result[key][-1], alone[key])


def differing(name: str) -> list[LossModule]:
    first, renamed, masked = make_bcq_loss(), make_bcq_loss(), make_bcq_loss()
    renamed.set_keys(action="move")
    masked.loss_mask_key = "mask"
    return {
        "none": [],
        "options": [first, make_bcq_loss(num_candidates=3)],
        "perturbation": [first, make_bcq_loss(perturbation=True)],
        "loss": [first, CASES["plas"].make()],
        "keys": [first, renamed],
        "mask": [first, masked],
        "itself": [first, first],
    }[name]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("none", "0 losses"),
        ("options", "'1' differs from '0'"),
        ("perturbation", "'1' differs from '0'"),
        ("loss", "'1' differs from '0'"),
        ("keys", "'1' differs from '0'"),
        ("mask", "'1' differs from '0'"),
        ("itself", "share parameters"),
    ],
)
def test_losses_that_cannot_be_stacked_are_refused(name: str, says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        StackedLoss(differing(name))


@pytest.mark.parametrize("names", [["a"], ["a", "a"], ["a", "b", "c"]])
def test_names_are_one_for_each_member(names: list[str]) -> None:
    with pytest.raises(BMRLError, match="each with its own name"):
        StackedLoss([make_bcq_loss(), make_bcq_loss()], names)


@vmap_or_loop
def test_wrong_data_are_refused(deactivate_vmap: bool) -> None:
    stack = StackedLoss(members(CASES["bcq"]), deactivate_vmap=deactivate_vmap)
    with pytest.raises(BMRLError, match=r"batch size is \[2, 8\]; valid: \[3, ...\]"):
        stack.qvalue_loss(batches(CASES["bcq"], 0)[:2])
    batch = batches(CASES["bcq"], 0)
    batch["action"][1, 0] = float("nan")
    with pytest.raises(BMRLError, match="'action' holds"):
        stack.generator_loss(batch)
    with pytest.raises(BMRLError, match="no 'action'"):
        stack.generator_loss(batch.exclude("action"))
