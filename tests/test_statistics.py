"""Bootstrap intervals agree with a plain resampling loop and cover what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.statistics import bootstrap_interval

pytest.importorskip("scipy")


def plain_bootstrap(
    groups: list[NDArray[np.float64]], *, resamples: int = 20_000
) -> tuple[float, float]:
    """The 2.5th and 97.5th percentiles of the mean, each group resampled on its own."""
    rng = np.random.default_rng(123)
    total = sum(rng.choice(g, (resamples, len(g))).sum(axis=1) for g in groups)
    low, high = np.percentile(total / sum(map(len, groups)), [2.5, 97.5])
    return float(low), float(high)


def test_interval_agrees_with_an_independent_bootstrap() -> None:
    values = np.random.default_rng(0).gamma(2.0, 40.0, size=30)
    width = np.diff(plain_bootstrap([values]))[0]
    assert bootstrap_interval(values) == pytest.approx(plain_bootstrap([values]), abs=0.06 * width)


def test_stratified_interval_agrees_with_an_independent_bootstrap() -> None:
    rng = np.random.default_rng(1)
    groups = [rng.normal(100.0, 5.0, 8), rng.normal(200.0, 15.0, 20), np.full(4, 50.0)]
    strata = np.repeat(["a", "b", "c"], [8, 20, 4])
    shuffle = rng.permutation(32)
    interval = bootstrap_interval(np.concatenate(groups)[shuffle], strata=strata[shuffle])
    width = np.diff(plain_bootstrap(groups))[0]
    assert interval == pytest.approx(plain_bootstrap(groups), abs=0.06 * width)


def test_differences_between_strata_do_not_widen_the_interval() -> None:
    values = np.concatenate([np.arange(10.0), 1000 + np.arange(10.0)])
    together = np.diff(bootstrap_interval(values))[0]
    apart = np.diff(bootstrap_interval(values, strata=np.repeat([0, 1], 10)))[0]
    assert apart < 5.0 < 300.0 < together  # the strata differ by 1000


def test_a_single_stratum_is_no_stratification() -> None:
    values = [1.0, 5.0, 2.0, 8.0]
    assert bootstrap_interval(values, strata=[3] * 4) == bootstrap_interval(values)


@pytest.mark.parametrize(("confidence", "least", "most"), [(0.95, 0.90, 0.98), (0.5, 0.42, 0.58)])
def test_coverage_of_a_known_mean(confidence: float, least: float, most: float) -> None:
    rng = np.random.default_rng(2)
    intervals = [
        bootstrap_interval(rng.normal(7.0, 2.0, 40), confidence=confidence, resamples=400)
        for _ in range(300)
    ]
    assert least < np.mean([low <= 7.0 <= high for low, high in intervals]) < most


def test_more_confidence_is_a_wider_interval() -> None:
    values = np.random.default_rng(3).normal(size=20)
    narrow, wide = (bootstrap_interval(values, confidence=c) for c in (0.5, 0.99))
    assert wide[0] < narrow[0] < narrow[1] < wide[1]


def test_success_rate_of_a_known_share() -> None:
    # Binomial(20, 0.9) / 20: the 2.5th percentile is 0.75, the 97.5th is 1.
    assert bootstrap_interval([1.0] * 18 + [0.0] * 2) == pytest.approx((0.75, 1.0))


@pytest.mark.parametrize("values", [[3.7], [0.1] * 7, [1.0] * 20])
def test_values_that_agree_give_no_width(values: list[float]) -> None:
    low, high = bootstrap_interval(values)
    assert low == high == np.mean(values)


def test_strata_of_one_value_each_give_no_width() -> None:
    assert bootstrap_interval([1.0, 5.0], strata=[0, 1]) == (3.0, 3.0)


def test_seed_decides_the_interval() -> None:
    values = np.random.default_rng(4).normal(size=20)
    assert bootstrap_interval(values, seed=5) == bootstrap_interval(values, seed=5)
    assert bootstrap_interval(values, seed=5) != bootstrap_interval(values, seed=6)


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        ([], {}, "non-empty"),
        ([[1.0], [2.0]], {}, r"\(2, 1\)"),
        ([1.0, float("nan")], {}, "1 non-finite"),
        ([1.0, 2.0], {"strata": [0]}, r"shape of values \(2,\), got \(1,\)"),
        ([1.0, 2.0], {"confidence": 95}, r"\(0, 1\), got 95"),
    ],
)
def test_bad_input_is_named(values: object, options: dict[str, object], message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        bootstrap_interval(values, **options)  # type: ignore[arg-type]
