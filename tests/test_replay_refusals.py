"""Data and options that no buffer can sample from are refused by name."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from replay_buffers import Make, episodes, every_buffer, every_ensemble, multi_task, numbered
from tensordict import TensorDict

from torchrl_bmrl.data import (
    make_mixed_replay_buffer,
    make_multi_task_replay_buffer,
    make_replay_buffer,
)
from torchrl_bmrl.data.replay import PART
from torchrl_bmrl.errors import BMRLError, ConfigError

# -- data ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["x", ("next", "reward")])
def test_numbers_that_are_not_finite_do_not_get_into_a_buffer(key: Any) -> None:
    data = episodes()
    data[key][5] = float("nan")
    with pytest.raises(BMRLError, match=r"is not finite in transition 5; valid: finite"):
        make_replay_buffer(data, batch_size=2)
    with pytest.raises(BMRLError, match=r"data set 1: .* is not finite in transition 5"):
        make_multi_task_replay_buffer([episodes(), data], batch_size=2)


def test_a_number_that_is_not_finite_is_found_in_any_part_of_long_data() -> None:
    data = TensorDict({"x": torch.zeros(PART + 10)}, [PART + 10])
    data["x"][PART + 3] = float("inf")
    with pytest.raises(BMRLError, match=f"is not finite in transition {PART + 3}; valid: finite"):
        make_replay_buffer(data, batch_size=2)


@every_ensemble
@pytest.mark.parametrize(
    ("key", "value", "difference"),
    [
        ("action", torch.zeros(8, 5), r"torch.float32 \(5,\), in data set 0 torch.float32 \(7,\)"),
        ("action", torch.zeros(8, 7).double(), r"torch.float64 \(7,\), in data set 0 torch.float3"),
        (("next", "reward"), None, r"missing, in data set 0 torch.float32 \(1,\)"),
        ("extra", torch.zeros(8, 2), r"torch.float32 \(2,\), in data set 0 missing"),
    ],
)
def test_data_sets_that_do_not_match_are_named_with_the_key(
    make: Make, key: Any, value: Any, difference: str
) -> None:
    other = episodes().exclude(key) if value is None else episodes().set(key, value)
    with pytest.raises(BMRLError, match="data set 2: .*" + difference) as caught:
        make([episodes(), episodes(), other])
    assert repr(key) in str(caught.value)


@every_ensemble
@pytest.mark.parametrize(
    ("datasets", "message"),
    [
        ([], "no data sets; valid: at least one"),
        ([numbered(0, 3), numbered(0, 0), numbered(0, 3)], r"data set 1: batch size \[0\]; valid"),
        ([numbered(0, 6).reshape(2, 3)] * 3, r"data set 0: batch size \[2, 3\]; valid: \[N\]"),
    ],
)
def test_data_sets_must_hold_transitions(
    make: Make, datasets: list[TensorDict], message: str
) -> None:
    with pytest.raises(BMRLError, match=message):
        make(datasets)


def test_data_must_hold_transitions() -> None:
    with pytest.raises(BMRLError, match=r"the data: batch size \[0\]; valid"):
        make_replay_buffer(numbered(0, 0), batch_size=2)


# -- options ---------------------------------------------------------------------------------------

BAD_WEIGHTS = ([1, 1], [1] * 4, [1, -1, 1], [1, float("nan"), 1], [1, float("inf"), 1], [0, 0, 0])


@every_ensemble
@pytest.mark.parametrize("weights", BAD_WEIGHTS)
def test_weights_must_be_one_valid_number_per_data_set(make: Make, weights: list[float]) -> None:
    with pytest.raises(ConfigError, match="valid: 3 finite numbers, one per data set"):
        make(weights=weights)


def test_a_task_without_weight_is_no_task() -> None:
    with pytest.raises(ConfigError, match="all positive"):
        multi_task(weights=[1, 0, 1])


@every_buffer
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prefetch": -1}, "prefetch is -1; valid: at least 0"),
        ({"prefetch": True}, "prefetch is True"),
        ({"device": "toaster"}, "device is 'toaster'; valid: "),
    ],
)
def test_options_of_no_sense_are_refused(make: Make, options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**options)


@pytest.mark.parametrize("batch_size", [0, -1, 2.0, True])
@pytest.mark.parametrize(
    "make", [make_replay_buffer, make_multi_task_replay_buffer, make_mixed_replay_buffer]
)
def test_a_batch_holds_at_least_one_transition(make: Make, batch_size: Any) -> None:
    data = numbered(0, 3) if make is make_replay_buffer else [numbered(0, 3)]
    options = {"weights": [1]} if make is make_mixed_replay_buffer else {}
    with pytest.raises(ConfigError, match=f"batch_size is {batch_size!r}; valid: at least 1"):
        make(data, batch_size=batch_size, **options)
