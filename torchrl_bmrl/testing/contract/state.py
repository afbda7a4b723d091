"""Checks of state, copies, dtypes, devices, and training."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import CudaGraphModule
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.contract.critics import needs_cuda
from torchrl_bmrl.testing.measures import all_of, assert_same, reached, run, same, state, total


def pickled(loss: LossModule) -> Any:
    """A copy, as it is sent to another process."""
    return pickle.loads(pickle.dumps(loss))


def moved(params: TensorDictParams) -> TensorDictParams:
    """Other parameters of the same shapes."""
    torch.manual_seed(3)
    values = params.data.clone()
    for value in values.values(True, True):
        if value.is_floating_point():
            value.add_(torch.randn_like(value), alpha=0.3)
    return TensorDictParams(values)


class StateChecks:
    """Checks of state, copies, types and devices, for every loss."""

    def test_state_dict_is_the_same_after_use_and_loads_strictly_both_ways(
        self, case: Case
    ) -> None:
        """It contains networks, targets and coefficients, and nothing that a call adds."""
        fresh, used = case.make(), case.make(seed=1)
        before = state(used)
        losses = run(used, case.batch())
        total(losses).backward()
        assert list(used.state_dict()) == list(before)
        assert not same(run(fresh, case.batch()), losses)
        case.make(seed=2).load_state_dict(used.state_dict(), strict=True)  # from used into fresh
        used.load_state_dict(case.make(seed=2).state_dict(), strict=True)  # and back
        fresh = case.make(seed=3)
        fresh.load_state_dict(used.state_dict(), strict=True)
        loaded = used.state_dict()
        assert all(torch.equal(value, loaded[key]) for key, value in state(fresh).items())
        assert_same(run(fresh, case.batch()), run(used, case.batch()), "with the state loaded")

    @pytest.mark.parametrize("copy", [deepcopy, pickled])
    @pytest.mark.parametrize("used", [False, True])
    def test_copies_give_the_same_losses_and_are_independent(
        self, case: Case, copy: Callable[[Any], Any], used: bool
    ) -> None:
        """A copy must not run or train the networks of the original."""
        loss = case.make()
        if used:
            loss(case.batch())
        twin = copy(loss)
        assert_same(run(twin, case.batch()), run(loss, case.batch()), "in a copy")
        before = state(loss)
        total(twin(case.batch())).backward()
        torch.optim.SGD(twin.parameters(), lr=1.0).step()
        assert all(parameter.grad is None for parameter in loss.parameters())
        assert all(torch.equal(value, before[key]) for key, value in state(loss).items())
        assert any(not torch.equal(value, before[key]) for key, value in state(twin).items())

    def test_assigned_parameters_are_used_from_the_next_call_on(self, case: Case) -> None:
        """A loss that stores tensors at its first call would continue with the old ones."""
        for name in sorted(all_of(case.trains)):
            loss, expected = case.make(), case.make()
            other = moved(getattr(loss, f"{name}_params"))
            before = run(loss, case.batch())
            setattr(loss, f"{name}_params", other)
            getattr(expected, f"{name}_params").data.copy_(other.data)
            losses = run(loss, case.batch())
            assert not same(losses, before), f"the loss goes on with the old {name}_params"
            assert_same(losses, run(expected, case.batch()), f"with other {name}_params")

    def test_a_functional_call_uses_the_given_parameters(self, case: Case) -> None:
        """``with params.to_module(loss):`` replaces the parameters inside the block."""
        loss, other = case.make(), case.make(seed=1)
        before, expected = run(loss, case.batch()), run(other, case.batch())
        params = TensorDict.from_module(other)
        with params.to_module(loss, preserve_module_state=False):
            inside = run(loss, case.batch())
        assert not same(inside, before), "the loss goes on with its own parameters"
        assert_same(inside, expected, "with the parameters of another loss")
        assert_same(run(loss, case.batch()), before, "after a functional call")

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("converted", [False, True])
    def test_losses_have_the_dtype_of_networks_and_data(
        self, case: Case, dtype: torch.dtype, converted: bool
    ) -> None:
        """Use ``register_coefficients`` for numbers; give new tensors the data's dtype."""
        other = torch.float32 if dtype == torch.float64 else torch.float64
        loss = case.make(dtype=other).to(dtype) if converted else case.make(dtype=dtype)
        data = case.batch(dtype=dtype)
        losses = loss(data)
        kinds = {key: value.dtype for key, value in losses.items()}
        kinds["the priority"] = data[loss.tensor_keys.priority].dtype
        assert {key for key, kind in kinds.items() if kind != dtype} == set()
        total(losses).backward()
        assert {p.grad.dtype for p in loss.parameters() if p.grad is not None} == {dtype}
        assert {key for key, x in loss.state_dict().items() if x.dtype == other} == set()

    def test_training_lowers_the_losses_on_one_batch(self, case: Case) -> None:
        """Name terms that follow another network in ``need_not_fall``."""
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
        for term in case.trains.keys() - {*case.need_not_fall}:
            first, last = (
                torch.stack([losses[f"loss_{term}"] for losses in part]).mean()
                for part in (history[:5], history[-5:])
            )
            assert last < 0.8 * first, f"60 updates took loss_{term} from {first} to {last}"

    @needs_cuda
    def test_a_loss_moves_to_the_gpu(self, case: Case) -> None:
        """Make new tensors on the device of the data."""
        loss, data = case.make().to("cuda"), case.batch().to("cuda")
        losses = loss(data)
        total(losses).backward()
        values = (*losses.values(), data[loss.tensor_keys.priority])
        assert {value.device.type for value in values} == {"cuda"}
        assert all(value.isfinite().all() for value in losses.values())
        assert reached(loss) == all_of(case.trains)

    @needs_cuda
    def test_an_update_replayed_as_a_cuda_graph_is_the_update(self, case: Case) -> None:
        """A loss must not read a number from the GPU in Python."""
        results = []
        term = f"loss_{'qvalue' if 'qvalue' in case.trains else next(iter(case.trains))}"
        for graphed in (False, True):
            loss = case.make().to("cuda")
            optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, capturable=True)

            def update(data: TensorDict, loss: Any = loss, optimizer: Any = optimizer) -> Any:
                optimizer.zero_grad(set_to_none=False)
                losses = loss(data)
                total(losses).backward()
                optimizer.step()
                return losses.detach()

            data = case.batch().to("cuda")
            torch.cuda.manual_seed(0)
            step = CudaGraphModule(update, in_keys=[], out_keys=[], warmup=5) if graphed else update
            results.append([step(data.clone())[term].item() for _ in range(20)])
        assert len(set(results[1][10:])) == 10
        # Capturing draws and updates once more, so the results are close, but not equal.
        plain, replayed = (sum(history[-5:]) / 5 for history in results)
        assert replayed == pytest.approx(plain, rel=0.5)


class OfflineStateChecks:
    """Checks of the batch's shape, for losses with critics."""

    def test_nested_batch_dimensions_are_rows_like_others(self, case: Case) -> None:
        """``self.rows`` determines the batch's shape for keyword calls, too."""
        if case.by_task:
            pytest.skip("the first dimension of this loss's batches are tasks")
        loss = case.make(reduction="none")
        data = case.batch(2, 4)
        flat = data.clone().reshape(8)
        nested, rows = run(loss, data), run(loss, flat)
        key = loss.tensor_keys.priority
        assert torch.equal(data[key].flatten(), flat[key])
        for term in case.trains:
            assert nested[f"loss_{term}"].shape == (2, 4), term
            torch.testing.assert_close(nested[f"loss_{term}"].flatten(), rows[f"loss_{term}"])
