"""Checks of the errors that a loss raises before it writes anything."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.measures import as_keywords, refused


def wider(value: Tensor) -> Tensor:
    """One number more in each row."""
    return torch.cat([value, value[..., :1]], -1)


def flat(value: Tensor) -> Tensor:
    """Without the last dimension."""
    return value.squeeze(-1)


class RefusalChecks:
    """Checks of errors, for every loss."""

    def test_actions_of_another_size_are_refused(self, case: Case) -> None:
        """``self.rows`` and ``self.call`` raise this error."""
        loss, data = case.make(), case.batch()
        key = loss.tensor_keys.action
        categorical = data[key].ndim == len(case.shape)
        data[key] = value = torch.stack([data[key]] * 2, -1) if categorical else wider(data[key])
        refused(loss, data, repr(key), str(tuple(value.shape)), "valid")

    @pytest.mark.parametrize("bad", [float("nan"), float("inf")])
    def test_numbers_that_are_not_finite_are_refused(self, case: Case, bad: float) -> None:
        """``self.rows`` raises this error, on CPU and not compiled."""
        loss = case.make()
        for key in (key for key in loss.in_keys if case.batch()[key].is_floating_point()):
            data = case.batch()
            data[key][-1, ..., -1] = bad
            refused(loss, data, repr(key), f"{bad}", "valid: finite numbers")


class OfflineRefusalChecks:
    """Checks of errors, for losses with critics."""

    @pytest.mark.parametrize("key", ["reward", "done", "terminated"])
    @pytest.mark.parametrize("change", [wider, flat])
    def test_rewards_and_flags_of_another_shape_are_refused(
        self, case: Case, key: str, change: Callable[[Tensor], Tensor]
    ) -> None:
        """``self.temporal_difference`` raises this error."""
        data = case.batch()
        data["next", key] = value = change(data["next", key])
        words = repr(("next", key)), str(tuple(value.shape)), f"valid: {(*case.shape, 1)}"
        refused(case.make(), data, *words)

    def test_next_observations_of_another_batch_are_refused(self, case: Case) -> None:
        """``self.rows(..., after=True)`` raises this error."""
        loss, data = case.make(), case.batch()
        outcomes = loss.outcome_keys
        key = next(key for key in loss.in_keys if key[0] == "next" and key not in outcomes)
        keywords = as_keywords(data, loss.in_keys)
        name = "_".join(key)
        keywords[name] = short = keywords[name][1:]
        with pytest.raises(BMRLError) as error:
            loss(**keywords)
        shape = ", ".join(map(str, case.shape))
        for word in (repr(key), str(tuple(short.shape)), f"valid: ({shape}"):
            assert word in str(error.value)
