"""Intervals over training runs and members cover what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.clusters import clustered_ratio
from torchrl_bmrl.evaluation.statistics import Estimate

pytest.importorskip("scipy")

TRUTH = 0.9
SCALE = 200.0


def labels(runs: int, members: int, episodes: int) -> dict[str, NDArray[np.int64]]:
    run, member, _ = np.indices((runs, members, episodes)).reshape(3, -1)
    return {"runs": run, "members": member}


def returns(
    rng: np.random.Generator, size: tuple[int, int, int], spread: tuple[float, float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns of a policy and of its reference; policies differ by run, by member, by episode."""
    runs, members, _ = size
    of_run, of_member, of_episode = spread
    level = SCALE * (1 + 0.2 * rng.standard_normal((1, members, 1)))  # members differ anyway
    start = 10 * rng.standard_normal(size)  # as do starts, for both policies
    share = TRUTH + of_run * rng.standard_normal((runs, 1, 1))
    share = share + of_member * rng.standard_normal((1, members, 1))
    noise = of_episode * SCALE * rng.standard_normal(size)
    return (share * level + start + noise).ravel(), (level + start).ravel()


@pytest.mark.parametrize(
    ("size", "spread", "least"),
    [
        ((3, 9, 5), (0.05, 0.05, 0.05), 0.93),
        ((3, 9, 5), (0.05, 0.01, 0.02), 0.92),
        ((3, 9, 5), (0.0, 0.05, 0.05), 0.93),
        ((3, 5, 5), (0.0, 0.0, 0.1), 0.93),
        ((5, 5, 3), (0.05, 0.05, 0.05), 0.93),
        ((2, 9, 5), (0.05, 0.05, 0.05), 0.88),
        ((1, 9, 5), (0.0, 0.05, 0.05), 0.93),
    ],
)
def test_coverage_of_a_known_ratio(
    size: tuple[int, int, int], spread: tuple[float, float, float], least: float
) -> None:
    rng = np.random.default_rng(0)
    of = labels(*size)
    found = [clustered_ratio(*returns(rng, size, spread), **of) for _ in range(1000)]
    covered = np.mean([each.low <= TRUTH <= each.high for each in found])
    assert least < covered
    assert np.mean([each.value for each in found]) == pytest.approx(TRUTH, abs=0.01)


def test_coverage_of_a_mean_over_families() -> None:
    rng = np.random.default_rng(1)
    sizes, spread = [(3, 9, 3), (3, 5, 3)], (0.05, 0.05, 0.05)
    groups = np.repeat([0, 1], [81, 45])
    of = {
        key: np.concatenate([labels(*size)[key] for size in sizes]) for key in ("runs", "members")
    }
    covered = 0
    for _ in range(500):
        x, y = (
            np.concatenate(z) for z in zip(*(returns(rng, s, spread) for s in sizes), strict=True)
        )
        # The second family's returns are much larger; both count the same.
        y[groups == 1], x[groups == 1] = 50 * y[groups == 1], 50 * x[groups == 1]
        found = clustered_ratio(x, y, groups=groups, **of)
        covered += found.low <= TRUTH <= found.high
    assert 0.92 < covered / 500 < 0.99


def test_episodes_of_the_same_run_and_member_are_no_new_evidence() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(1.0, 0.1, (3, 4))
    once = clustered_ratio(x.ravel(), **labels(3, 4, 1))
    often = clustered_ratio(np.repeat(x.ravel(), 50), **labels(3, 4, 50))
    assert (often.value, often.low, often.high) == pytest.approx((once.value, once.low, once.high))


def test_one_run_gives_the_t_interval_of_its_members_and_one_member_that_of_its_runs() -> None:
    from scipy.stats import t

    x = np.array([0.7, 0.8, 1.0, 0.9, 0.6])
    low, high = t.interval(0.95, 4, loc=x.mean(), scale=x.std(ddof=1) / np.sqrt(5))
    for size in ((1, 5, 2), (5, 1, 2)):
        found = clustered_ratio(np.repeat(x, 2), **labels(*size))
        assert (found.low, found.high) == pytest.approx((low, high))
    found = clustered_ratio(x, **labels(1, 1, 5))  # episodes are all that is left
    assert (found.low, found.high) == pytest.approx((low, high))
    assert clustered_ratio([0.5], **labels(1, 1, 1)) == Estimate(value=0.5, low=0.5, high=0.5)


def test_a_constant_share_has_no_width_however_members_differ() -> None:
    y = np.arange(1.0, 13.0)
    found = clustered_ratio(0.8 * y, y, **labels(2, 3, 2))
    assert (found.low, found.value, found.high) == pytest.approx((0.8, 0.8, 0.8))


def test_the_order_of_the_episodes_and_the_names_change_nothing() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.gamma(4.0, size=(2, 24))
    of = labels(2, 4, 3)
    order = rng.permutation(24)
    named = {
        key: np.array([f"{key}-{9 - i}" for i in value], dtype=object)[order]
        for key, value in of.items()
    }
    expected, found = clustered_ratio(x, y, **of), clustered_ratio(x[order], y[order], **named)
    assert (found.low, found.value, found.high) == pytest.approx(
        (expected.low, expected.value, expected.high)
    )


@pytest.mark.parametrize(
    ("x", "y", "runs", "message"),
    [
        ([], None, [], r"x has shape \(0,\)"),
        ([1.0, 2.0], None, [0], r"runs has shape \(1,\)"),
        ([1.0, 2.0], [1.0], [0, 0], r"y has shape \(1,\)"),
        ([1.0, float("nan")], None, [0, 0], "x has values that are not finite"),
        ([1.0, 2.0], [1.0, -1.0], [0, 0], "the mean of y is 0.0; valid: above 0"),
    ],
)
def test_bad_input_is_named(x: object, y: object, runs: object, message: str) -> None:
    members = np.arange(np.size(x))
    with pytest.raises(BMRLError, match=message):
        clustered_ratio(x, y, runs=runs, members=members)  # type: ignore[arg-type]


def test_a_run_without_a_member_is_an_error() -> None:
    with pytest.raises(BMRLError, match="run b has no episode of y; valid: all members"):
        clustered_ratio([1.0, 2.0, 3.0], runs=["a", "a", "b"], members=["x", "y", "x"])
