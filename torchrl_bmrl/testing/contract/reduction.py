"""Checks of reduction, masks, priority weights and the priority."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer

from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.measures import assert_same, gradients, run, same, total, unwritten


def reduced(case: Case, reduction: str | None, data: TensorDict, **options: Any) -> dict[str, Any]:
    """The terms under one reduction."""
    losses = run(case.make(reduction=reduction, **options), data)
    return {term: losses[f"loss_{term}"] for term in case.trains}


def weights(data: TensorDict) -> Tensor:
    """A priority weight for each row."""
    return torch.linspace(0.1, 1.0, data.numel(), dtype=torch.float64).view(data.shape)


def some_rows(data: TensorDict) -> Tensor:
    """A mask that excludes every third row."""
    return torch.arange(data.numel()).view(data.shape) % 3 > 0


def padded(data: TensorDict, mask: Tensor, value: float) -> TensorDict:
    """The data with a mask, and one value in all numbers of the masked rows."""
    data = data.clone()
    for key, entry in data.items(True, True):
        if entry.is_floating_point():
            data[key] = torch.where(
                mask.view(*mask.shape, *[1] * (entry.ndim - mask.ndim)), entry, value
            )
    data["collector", "mask"] = mask.unsqueeze(-1)
    return data


class ReductionChecks:
    """Checks of reductions, masks and priorities, for every loss."""

    def test_reductions_agree(self, case: Case) -> None:
        """Every term goes through ``self.reduce``, with a number for each row."""
        rows, sums, means = (reduced(case, name, case.batch()) for name in ("none", "sum", "mean"))
        for term in case.trains:
            assert rows[term].shape == case.shape, f"loss_{term} has not one number for each row"
            torch.testing.assert_close(sums[term], rows[term].sum(), msg=_about(term))
            torch.testing.assert_close(means[term], rows[term].mean(), msg=_about(term))

    def test_no_reduction_given_is_the_mean(self, case: Case) -> None:
        """``reduction=None`` is TorchRL's default."""
        means, defaults = (reduced(case, name, case.batch()) for name in ("mean", None))
        for term in case.trains:
            assert torch.equal(defaults[term], means[term]), term

    @pytest.mark.parametrize("key", [("collector", "mask"), "valid"])
    def test_masked_rows_do_not_count_in_any_term(self, case: Case, key: Any) -> None:
        """No term may combine or average rows before it is reduced."""
        loss, data = case.make(), case.batch()
        rows = reduced(case, "none", data)
        mask = some_rows(data)
        data[key] = mask.unsqueeze(-1)
        if key == "valid":
            loss.loss_mask_key = key
        losses = run(loss, data)
        for term in () if case.mixes_rows else case.trains:
            expected = rows[term][mask].mean()
            torch.testing.assert_close(losses[f"loss_{term}"], expected, msg=_about(term))

    @pytest.mark.parametrize("padding", [float("nan"), 7.0])
    def test_padded_rows_may_hold_anything(self, case: Case, padding: float) -> None:
        """Masked rows change no loss, gradient, metric or priority."""
        mask = some_rows(case.batch())
        results: list[Any] = []
        for value in (0.0, padding):
            loss, data = case.make(), padded(case.batch(), mask, value)
            losses = run(loss, data)
            total(losses).backward()
            entries = losses.detach().to_dict() | gradients(loss)
            results.append(entries | {"the priority": data[loss.tensor_keys.priority]})
        for key, value in results[0].items():
            torch.testing.assert_close(results[1][key], value, msg=_about(key))

    @pytest.mark.parametrize("use", ["auto", True, False])
    def test_priority_weights_weigh_every_term(self, case: Case, use: str | bool) -> None:
        """Every term goes through ``self.reduce``, with the data."""
        loss, data = case.make(), case.batch()
        rows = reduced(case, "none", data)
        data[loss.tensor_keys.priority_weight] = weight = weights(data)
        values = reduced(case, "mean", data, use_prioritized_weights=use)
        for term, row in rows.items():
            expected = row.mean() if use is False else (row * weight).sum() / weight.sum()
            torch.testing.assert_close(values[term], expected, msg=_about(term))

    def test_the_key_of_the_priority_weights_may_be_nested(self, case: Case) -> None:
        """TorchRL's own losses do not find a nested key."""
        loss, data = case.make(), case.batch()
        data[loss.tensor_keys.priority_weight] = weight = weights(data)
        expected = run(loss, data)
        loss.set_keys(priority_weight=("buffer", "weight"))
        data = case.batch()
        run(loss, data)  # without weights, too
        data["buffer", "weight"] = weight
        assert_same(run(loss, data), expected, "with weights under a nested key")

    def test_forward_writes_the_priority_and_leaves_the_rest_of_the_input(self, case: Case) -> None:
        """The priority of a row is finite, not negative, and without a gradient."""
        loss, data = case.make(), case.batch()
        before, values = dict(data.items(True, True)), data.clone()
        run(loss, data)
        priority = data.pop(loss.tensor_keys.priority)
        assert priority.shape == case.shape, "the priority is not one number for each row"
        assert priority.isfinite().all()
        assert (priority >= 0).all()
        assert len(priority.unique()) > 1
        assert not priority.requires_grad
        unwritten(data, before, "the input")
        assert same(data, values), "the loss changed entries of the input in place"

    def test_a_prioritised_buffer_takes_the_priority_back(self, case: Case) -> None:
        """A round through TorchRL's sampler, which computes in float32."""
        data = case.batch(dtype=torch.float32).reshape(-1)
        loss = case.make(dtype=torch.float32)
        try:
            buffer = TensorDictPrioritizedReplayBuffer(
                alpha=1.0,
                beta=1.0,
                eps=0.0,
                priority_key=loss.tensor_keys.priority,
                storage=LazyTensorStorage(len(data)),
                batch_size=len(data),
            )
        except RuntimeError as error:
            if "SumSegmentTreeFp32 is not available" not in str(error):
                raise
            pytest.skip("this torch lacks torchrl's C++ sampler: SumSegmentTreeFp32")
        buffer.extend(data)
        sample = buffer.sample().reshape(case.shape)
        assert (sample["priority_weight"] == 1).all()
        loss(sample)
        buffer.update_tensordict_priority(sample.reshape(-1))
        assert len(buffer.sample()["priority_weight"].unique()) > 1
        loss(buffer.sample().reshape(case.shape))


def draw_zeros(patch: pytest.MonkeyPatch) -> None:
    """Makes torch draw zeros, so that a row's losses do not depend on earlier rows."""
    for name in ("randn", "randn_like", "rand", "rand_like", "normal"):
        drawn = getattr(torch, name)
        patch.setattr(torch, name, lambda *x, drawn=drawn, **o: torch.zeros_like(drawn(*x, **o)))


class OfflineReductionChecks:
    """Checks of reductions, masks and priorities, for losses with critics."""

    def test_padded_rows_count_in_no_metric_and_no_priority(
        self, case: Case, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Metrics are means over the valid rows; the priority of the others is 0."""
        if case.by_task:
            pytest.skip("rows of this loss cannot be left out, since each is one of its task's")
        loss, mask = case.make(), some_rows(case.batch())
        left, data = case.batch()[mask], padded(case.batch(), mask, 7.0)
        draw_zeros(monkeypatch)
        expected, others, losses = run(loss, left), run(loss, left.clone(), seed=1), run(loss, data)
        for key, value in expected.items():
            if torch.equal(value, others[key]):  # else the loss draws by a function of its own
                torch.testing.assert_close(losses[key], value, msg=_about(key))
        priority = data[loss.tensor_keys.priority]
        assert (priority[~mask] == 0).all(), "padded rows have a priority"
        torch.testing.assert_close(priority[mask], left[loss.tensor_keys.priority])

    def test_methods_leave_the_input_and_are_the_terms_of_forward(self, case: Case) -> None:
        """A method returns its term and metrics; ``forward`` collects them in update order."""
        loss, data = case.make(), case.batch()
        before, values = dict(data.items(True, True)), data.clone()
        torch.manual_seed(0)
        results = {term: getattr(loss, f"{term}_loss")(data) for term in case.trains}
        unwritten(data, before, "the input of its methods")
        assert same(data, values), "a method changed entries of the input in place"
        losses = run(loss, data)
        for term, (value, info) in results.items():
            assert torch.equal(value, losses[f"loss_{term}"]), term
            for key in info.keys() & set(loss.out_keys):
                assert torch.equal(info[key], losses[key]), key
        priority = results["qvalue"][1]["td_error"].amax(0)
        assert torch.equal(data[loss.tensor_keys.priority], priority)


def _about(what: str) -> Any:
    """A message for a comparison that names the compared entry."""
    return lambda message: f"{what}: {message}"
