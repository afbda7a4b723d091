"""Updates in one piece: the same eager, compiled and captured."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any

import pytest
import torch
from helpers import NO_UPDATER, make_bcq_loss, make_distillation_loss, task_transitions, transitions
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import StackedLoss
from torchrl_bmrl.training import accelerate, gradient_step, load_adam, make_adam

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
Update = Callable[[TensorDict], dict[str, Tensor]]
LR = 2**-7  # which every type holds exactly
compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no compiler"
)


def a_network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 1)).double()


@pytest.mark.parametrize("max_norm", [None, 0.1, 100.0])
def test_a_gradient_step_is_backward_and_step(max_norm: float | None) -> None:
    one, other = a_network(), a_network()
    ours = make_adam(one.parameters(), lr=LR)
    theirs = torch.optim.Adam(other.parameters(), lr=LR)
    for seed in range(20):
        x = torch.randn(16, 3, generator=torch.Generator().manual_seed(seed)).double()
        gradient_step(ours, one(x).square().mean(), max_norm)
        theirs.zero_grad()
        other(x).square().mean().backward()
        if max_norm is not None:
            clip_grad_norm_(other.parameters(), max_norm)
        theirs.step()
    for ours_, theirs_ in zip(one.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(ours_, theirs_, rtol=1e-9, atol=1e-12)
        assert ours_.grad is None


def test_a_gradient_step_leaves_what_the_loss_does_not_reach() -> None:
    used, unused = nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(1))
    gradient_step(make_adam([used, unused], lr=LR), used.square())
    assert used.item() < 1
    assert unused.item() == 1


def test_a_changed_learning_rate_counts_from_the_next_step() -> None:
    weight = nn.Parameter(torch.ones(1))
    optimizer = make_adam([weight], lr=LR)
    optimizer.param_groups[0]["lr"].fill_(0.0)
    gradient_step(optimizer, weight.square())
    assert weight.item() == 1


def test_an_optimizer_goes_on_from_its_state() -> None:
    def steps(count: int, state: Any = None, weight: float = 1.0) -> tuple[float, Any]:
        parameter = nn.Parameter(torch.tensor([weight], dtype=torch.float64))
        optimizer = make_adam([parameter], lr=LR)
        if state is not None:
            load_adam(optimizer, state)
        for _ in range(count):
            gradient_step(optimizer, parameter.square())
        return parameter.item(), optimizer.state_dict()

    half, state = steps(5)
    assert steps(5, state, half)[0] == steps(10)[0] != steps(5, None, half)[0]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_freed_memory_is_kept_and_not_taken_anew_page_by_page() -> None:
    code = """
import resource, sys, torch
from torchrl_bmrl.training import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def work():
    several = [torch.ones(2**20) for _ in range(8)]  # of 4 MiB
for _ in range(5):
    work()
before = faults()
for _ in range(50):
    work()
print(faults() - before)
"""
    # By itself glibc sometimes learns to keep blocks of this size; here it hands all of them back.
    env = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072"}
    taken = {
        how: int(subprocess.check_output([sys.executable, "-c", code, how], env=env, text=True))
        for how in ("keep", "leave")
    }
    # The heap may still grow once, by some of a round's 8,192 pages.
    assert 5 * taken["keep"] < taken["leave"]


# -- compiled and captured -------------------------------------------------------------------------


def bcq_update(members: int, device: str = "cpu", **options: Any) -> tuple[Any, Update]:
    """A loss, or a stack of several, and its update as the recipe makes it."""
    losses = [make_bcq_loss(seed=seed, dtype=torch.float64) for seed in range(max(members, 1))]
    loss = (StackedLoss(losses, **options) if members else losses[0]).to(device)
    optimizers = {
        name: make_adam(getattr(loss, f"{name}_params").parameters(), lr=LR)
        for name in ("generator", "qvalue_network")
    }
    targets = SoftUpdate(loss, tau=0.1)

    def update(batch: TensorDict) -> dict[str, Tensor]:
        metrics = {}
        for name, optimizer in optimizers.items():
            value, info = getattr(loss, f"{name.removesuffix('_network')}_loss")(batch)
            gradient_step(optimizer, value, 1.0)
            metrics |= {name: value.detach()} | info
        targets.step()
        return metrics

    return loss, update


def bcq_batch(members: int, seed: int, device: str = "cpu") -> TensorDict:
    shape = (members, 8) if members else (8,)
    batch = transitions(*shape, dtype=torch.float64, seed=seed).to(device)
    return batch.exclude(("next", "truncated"))


def distillation_update(members: int) -> tuple[Any, Update]:
    loss = make_distillation_loss(dtype=torch.float64, context="set")
    optimizer = make_adam(loss.parameters(), lr=LR)

    def update(batch: TensorDict) -> dict[str, Tensor]:
        losses = loss(batch)
        gradient_step(optimizer, sum(v for k, v in losses.items() if k.startswith("loss_")))
        return {name: value.detach() for name, value in losses.items()}

    return loss, update


def distillation_batch(members: int, seed: int) -> TensorDict:
    return task_transitions(3, 5, dtype=torch.float64).exclude("previous")


CASES = {
    "bcq": (bcq_update, bcq_batch, 0),
    "stacked_bcq": (partial(bcq_update, deactivate_vmap=False), bcq_batch, 2),
    "distillation": (distillation_update, distillation_batch, 0),
}


@compiler
@pytest.mark.slow
@pytest.mark.parametrize(("make", "batch", "members"), CASES.values(), ids=CASES)
def test_a_compiled_update_is_one_program_and_equals_the_eager_one(
    make: Any, batch: Any, members: int, caplog: pytest.LogCaptureFixture
) -> None:
    torch.compiler.reset()
    states = []
    for compiled in (False, True):
        loss, update = make(members)
        update = accelerate(update, compiled=compiled)
        torch.manual_seed(0)
        for seed in range(50):
            # From the second update on nothing may be compiled anew.
            with torch._dynamo.config.patch(error_on_recompile=seed > 1):
                metrics = update(batch(members, seed))
        states.append((loss.state_dict(), metrics))
    assert "not accelerated" not in caplog.text
    for eager, fast in zip(*states, strict=True):
        assert eager.keys() == fast.keys()
        for key, value in eager.items():
            torch.testing.assert_close(fast[key], value, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_what_others_compile_beside_an_update_still_trains() -> None:
    weight, other = nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(1))
    optimizer, theirs = make_adam([weight], lr=LR), torch.optim.Adam([other], lr=LR)

    def update(batch: TensorDict) -> dict[str, Tensor]:
        gradient_step(optimizer, (weight * batch["x"]).square().sum())
        return {}

    def usual(batch: TensorDict) -> None:
        loss = (other * batch["x"]).square().sum()
        theirs.zero_grad()
        loss.backward()
        theirs.step()

    batch = TensorDict({"x": torch.ones(1)}, [])
    accelerate(update, compiled=True)(batch)
    torch.compile(usual, backend="eager")(batch)
    assert weight.item() < 1
    assert other.item() < 1


@pytest.mark.gpu
@pytest.mark.parametrize("compiled", [False, True])
def test_a_captured_update_equals_the_eager_one(
    compiled: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch, "randn", lambda *s, **o: torch.full(as_size(s), 0.3, **o))
    monkeypatch.setattr(torch, "randn_like", lambda x: torch.full_like(x, 0.3))
    states = []
    for options in ({}, {"compiled": compiled, "captured": True}):
        loss, update = bcq_update(3, "cuda")
        update = accelerate(update, device="cuda", **options)
        for seed in range(50):
            metrics = update(bcq_batch(3, seed, "cuda"))
        states.append((loss.state_dict(), metrics))
    assert "not accelerated" not in caplog.text
    for eager, fast in zip(*states, strict=True):
        for key, value in eager.items():
            torch.testing.assert_close(fast[key], value, rtol=0, atol=1e-10)


@pytest.mark.gpu
def test_every_replay_draws_new_noise() -> None:
    _, update = bcq_update(2, "cuda")
    update = accelerate(update, device="cuda", captured=True)
    values = [update(bcq_batch(2, 0, "cuda"))["next_state_value"].tolist() for _ in range(10)]
    assert len({tuple(value) for value in values}) == 10


def as_size(shape: tuple[Any, ...]) -> Any:
    return shape[0] if len(shape) == 1 and not isinstance(shape[0], int) else shape


def channels_last() -> nn.Module:
    """A convolution whose parameters lie with their channels last."""
    torch.manual_seed(0)
    module = nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU(), nn.Flatten(), nn.Linear(4 * 36, 1))
    return module.to(memory_format=torch.channels_last)


def trained(module: nn.Module, step: Any, updates: int = 20) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    for _ in range(updates):
        images = torch.randn(16, 3, 8, 8, generator=generator)
        step((module(images).squeeze(-1) - images.mean((1, 2, 3))).square().mean())
    return [parameter.detach().clone() for parameter in module.parameters()]


def test_parameters_of_another_layout_are_trained_as_by_torch_s_adam() -> None:
    ours, theirs = channels_last(), channels_last()
    assert not next(ours.parameters()).is_contiguous()
    optimizer = make_adam(ours.parameters(), lr=1e-2)
    adam = torch.optim.Adam(theirs.parameters(), lr=1e-2)

    def usual(loss: Tensor) -> None:
        adam.zero_grad()
        loss.backward()
        adam.step()

    expected = trained(theirs, usual)
    result = trained(ours, lambda loss: gradient_step(optimizer, loss))
    for one, other in zip(result, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)


def test_an_optimizer_goes_on_with_a_state_of_another_layout() -> None:
    through, resumed = channels_last(), channels_last()
    optimizer = make_adam(through.parameters(), lr=1e-2)
    trained(through, lambda loss: gradient_step(optimizer, loss))
    resumed.load_state_dict(through.state_dict())
    other, state = make_adam(resumed.parameters(), lr=1e-2), deepcopy(optimizer.state_dict())
    for held in state["state"].values():  # as a file returns it
        held |= {name: held[name].contiguous() for name in ("exp_avg", "exp_avg_sq")}
    load_adam(other, state)
    results = [
        trained(module, lambda loss, adam=adam: gradient_step(adam, loss))
        for module, adam in ((through, optimizer), (resumed, other))
    ]
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("view", [lambda x: x[:, :3], lambda x: x[:1].expand(4, 8)])
def test_parameters_with_gaps_or_overlaps_are_refused(view: Any) -> None:
    parameter = nn.Parameter(torch.zeros(4, 8))
    parameter.data = view(parameter.data)
    with pytest.raises(BMRLError, match=r"strides \(.*\); valid: dense memory"):
        make_adam([parameter], lr=1e-2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weight_decay": 0.1}, "weight_decay of the optimizer is 0.1; valid: 0"),
        ({"amsgrad": True}, "amsgrad of the optimizer is True; valid: 0"),
        ({"lr": 0.1}, "1 groups of parameters and lr 0.1; valid: an optimizer of make_adam"),
    ],
)
def test_options_that_a_gradient_step_does_not_take_are_refused(
    options: dict[str, Any], message: str
) -> None:
    parameter = nn.Parameter(torch.ones(1))
    optimizer = torch.optim.Adam([parameter], **{"lr": torch.tensor(0.1), "fused": True, **options})
    with pytest.raises(BMRLError, match=message):
        gradient_step(optimizer, parameter.square())


class Waiting(TorchDispatchMode):
    """Refuses what would make Python wait for a device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        names = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "is_nonzero")
        assert func.overloadpacket.__name__ not in names, func
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("members", [0, 3])
def test_an_update_never_waits_for_its_device(
    members: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.objectives import data as checked

    _, update = bcq_update(members, **({"deactivate_vmap": False} if members else {}))
    batch = bcq_batch(members, 0)
    with pytest.raises(AssertionError, match="_local_scalar_dense"), Waiting():
        update(batch)  # on CPU the data are looked at
    monkeypatch.setattr(checked, "readable", lambda value: False)  # as on another device
    with Waiting():
        update(batch)


# -- where it fails --------------------------------------------------------------------------------


def test_an_update_that_cannot_be_compiled_runs_as_it_is(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "torchrl_bmrl")
    calls = []

    def update(batch: TensorDict) -> dict[str, Tensor]:
        calls.append(batch["x"].sum().item())  # looks at a number
        if calls[-1] > 0:
            print("positive")
        return {"x": batch["x"]}

    fast = accelerate(update, compiled=True)
    batch = TensorDict({"x": torch.ones(2)}, [2])
    for _ in range(3):
        assert fast(batch)["x"] is batch["x"]
    announced, line = caplog.messages
    assert announced == "compiling the updates, which takes about half a minute"
    assert line.startswith("updates are not accelerated (")
    assert line.endswith("they run eagerly")
    assert calls == [2.0] * 3


def test_without_a_gpu_nothing_is_captured_and_that_is_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    _, update = bcq_update(0)
    assert accelerate(update, captured=True) is update
    assert caplog.messages == ["device=cpu has no CUDA graphs; the updates run without them"]


def test_an_error_of_the_update_itself_is_its_own() -> None:
    def update(batch: TensorDict) -> dict[str, Tensor]:
        raise BMRLError("'action' is missing")

    with pytest.raises(BMRLError, match="'action' is missing"):
        accelerate(update, compiled=True)(TensorDict({}, []))


def test_nothing_is_wrapped_that_was_not_asked_for() -> None:
    _, update = bcq_update(0)
    assert accelerate(update) is update
