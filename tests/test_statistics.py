"""Bootstrap intervals agree with a plain resampling loop and cover what they promise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.statistics import (
    bootstrap_interval,
    probability_of_improvement,
    rank_correlation,
    relative_difference,
)

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


def test_coverage_of_a_known_mean() -> None:
    rng = np.random.default_rng(2)
    intervals = [bootstrap_interval(rng.normal(7.0, 2.0, 40)) for _ in range(300)]
    assert 0.90 < np.mean([low <= 7.0 <= high for low, high in intervals]) < 0.98


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
    ],
)
def test_bad_input_is_named(values: object, options: dict[str, object], message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        bootstrap_interval(values, **options)  # type: ignore[arg-type]


# What sets two policies apart


def pairs(seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Returns of two policies from the same starts, which decide most of them, and their strata."""
    rng = np.random.default_rng(seed)
    strata = np.repeat([1, 2, 3], [12, 20, 9])
    start = rng.normal(100.0, 20.0, strata.size)
    noise = rng.normal(0.0, 2.0, (2, strata.size))
    return 1.05 * start + noise[0], start + noise[1], strata


def resampled(strata: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows drawn with replacement within each stratum."""
    return np.concatenate(
        [rng.choice(np.flatnonzero(strata == s), (strata == s).sum()) for s in (1, 2, 3)]
    )


def percentiles(values: list[float]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def test_relative_difference_agrees_with_an_independent_paired_bootstrap() -> None:
    x, y, strata = pairs()
    rng = np.random.default_rng(7)
    drawn = [resampled(strata, rng) for _ in range(5000)]
    low, high = percentiles([x[rows].mean() / y[rows].mean() - 1 for rows in drawn])
    found = relative_difference(x, y, strata=strata)
    assert found.value == pytest.approx(x.mean() / y.mean() - 1)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.08 * (high - low))


def test_difficult_starts_are_no_difference() -> None:
    x, y, strata = pairs()
    found = relative_difference(x, y, strata=strata)
    rng = np.random.default_rng(8)
    rows = [(resampled(strata, rng), resampled(strata, rng)) for _ in range(2000)]
    low, high = percentiles([x[a].mean() / y[b].mean() - 1 for a, b in rows])
    assert found.high - found.low < 0.3 * (high - low)  # unpaired


def test_relative_difference_over_groups_is_the_mean_of_theirs() -> None:
    x, y, strata = pairs()
    scale = np.where(strata == 2, 5.0, 1.0)  # a task of larger returns must not count for more
    found = relative_difference(scale * x, scale * y, groups=strata)
    each = [relative_difference(x[strata == s], y[strata == s]).value for s in (1, 2, 3)]
    assert found.value == pytest.approx(np.mean(each))
    assert found.low < found.value < found.high
    rng = np.random.default_rng(9)
    drawn = [resampled(strata, rng) for _ in range(5000)]
    means = [
        np.mean([x[r[strata == s]].mean() / y[r[strata == s]].mean() - 1 for s in (1, 2, 3)])
        for r in drawn
    ]
    low, high = percentiles(means)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.08 * (high - low))


def test_probability_of_improvement_is_the_mean_of_mann_whitneys_over_strata() -> None:
    from scipy.stats import mannwhitneyu

    x, y, strata = pairs()
    x, y = np.round(x, -1), np.round(y, -1)  # with ties
    assert np.intersect1d(x, y).size
    few = np.r_[0:5, 12:30, 32:41]  # of y, fewer than of x
    each = []
    for s in (1, 2, 3):
        mine, others = x[strata == s], y[few][strata[few] == s]
        each.append(mannwhitneyu(mine, others).statistic / (mine.size * others.size))
    found = probability_of_improvement(x, y[few], x_strata=strata, y_strata=strata[few])
    assert found.value == pytest.approx(np.mean(each))


def test_interval_of_the_probability_agrees_with_an_independent_bootstrap() -> None:
    x, y, strata = pairs()
    rng = np.random.default_rng(10)
    values = []
    for _ in range(3000):
        a, b = resampled(strata, rng), resampled(strata, rng)
        shares = [(x[a][strata == s][:, None] > y[b][strata == s][None]).mean() for s in (1, 2, 3)]
        values.append(np.mean(shares))
    low, high = percentiles(values)
    found = probability_of_improvement(x, y, x_strata=strata, y_strata=strata)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.08 * (high - low))


def test_the_order_of_rows_changes_nothing() -> None:
    x, y, strata = pairs()
    order, other = (np.random.default_rng(s).permutation(x.size) for s in (1, 2))
    groups = np.arange(x.size) % 2
    assert relative_difference(x, y, strata=strata, groups=groups) == relative_difference(
        x[order], y[order], strata=strata[order], groups=groups[order]
    )
    assert probability_of_improvement(
        x, y, x_strata=strata, y_strata=strata
    ) == probability_of_improvement(
        x[order], y[other], x_strata=strata[order], y_strata=strata[other]
    )


def test_resamples_without_a_relative_difference_are_left_out() -> None:
    # Pairs: both first, -2/3; one of each, 0; both second, a negative mean of y.
    found = relative_difference([1.0, 1.0], [3.0, -1.0])
    assert (found.value, found.low, found.high) == pytest.approx((0.0, -2 / 3, 0.0))


def test_constant_values_give_no_width() -> None:
    x, y, strata = np.full(41, 90.0), np.full(41, 100.0), pairs()[2]
    found = relative_difference(x, y, strata=strata)
    assert found.low == found.high == found.value == pytest.approx(-0.1)
    chance = probability_of_improvement(x, y, x_strata=strata, y_strata=strata)
    assert (chance.value, chance.low, chance.high) == (0.0, 0.0, 0.0)
    chance = probability_of_improvement(y, y, x_strata=strata, y_strata=strata)
    assert (chance.value, chance.low, chance.high) == (0.5, 0.5, 0.5)


def test_strata_of_one_episode_stay_what_they_are() -> None:
    x, y = [110.0, 220.0, 230.0], [100.0, 200.0, 190.0]
    found = relative_difference(x, y, strata=[0, 1, 1])
    extremes = ((110 + 440) / 500 - 1, (110 + 460) / 480 - 1)
    assert (found.low, found.high) == pytest.approx(extremes)
    assert relative_difference([3.0], [2.0]).low == 0.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: relative_difference([1.0, 2.0], [1.0]), "2 and 1 values"),
        (lambda: relative_difference([1.0], [0.0]), "mean of y is 0.0; valid: above 0"),
        (lambda: relative_difference([1.0], [float("inf")]), "finite y.* 1 non-finite"),
        (lambda: relative_difference([1.0, 2.0], [1.0, 2.0], groups=[1]), r"\(2,\), got \(1,\)"),
        (
            lambda: probability_of_improvement([1.0], [1.0], x_strata=[1], y_strata=[2]),
            r"\[1\], those of y \[2\]",
        ),
    ],
)
def test_what_cannot_be_compared_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        call()


# Whether one measure orders as another does


def test_rank_correlation_is_spearmans_with_ties_as_scipy_has_it() -> None:
    from scipy.stats import spearmanr

    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 6, 30), rng.integers(0, 6, 30)
    assert rank_correlation(x, y).value == pytest.approx(spearmanr(x, y).statistic, abs=1e-12)


def test_only_the_order_counts_in_a_rank_correlation() -> None:
    x = np.random.default_rng(1).normal(size=8)
    assert rank_correlation(x, np.exp(5 * x)).value == pytest.approx(1.0)
    assert rank_correlation(x, -(x**3)).value == pytest.approx(-1.0)


def test_ranks_are_those_within_a_group_and_groups_count_alike() -> None:
    x = [1.0, 2.0, 3.0, 101.0, 102.0]
    y = [30.0, 20.0, 10.0, 1.0, 2.0]
    assert rank_correlation(x, y, groups=[0, 0, 0, 1, 1]).value == pytest.approx(0.0)
    assert rank_correlation(x, y).value == pytest.approx(-0.9)


def test_a_measure_without_order_counts_as_no_correlation() -> None:
    estimate = rank_correlation([1.0, 1.0, 1.0], [1.0, 2.0, 3.0])
    assert (estimate.value, estimate.low, estimate.high) == (0.0, 0.0, 0.0)


def test_interval_of_the_rank_correlation_agrees_with_an_independent_bootstrap() -> None:
    from scipy.stats import spearmanr

    rng = np.random.default_rng(2)
    x = rng.normal(size=24)
    y, groups = x + rng.normal(size=24), np.repeat([0, 1], 12)
    found = rank_correlation(x, y, groups=groups)
    values = []
    for _ in range(2000):
        drawn = [rng.choice(np.flatnonzero(groups == g), 12) for g in (0, 1)]
        values.append(float(np.mean([spearmanr(x[rows], y[rows]).statistic for rows in drawn])))
    low, high = percentiles(values)
    assert found.low == pytest.approx(low, abs=0.04)
    assert found.high == pytest.approx(high, abs=0.04)


def test_rank_correlation_names_what_is_no_pair() -> None:
    with pytest.raises(BMRLError, match="x and y are pairs; got 2 and 3 values"):
        rank_correlation([1.0, 2.0], [1.0, 2.0, 3.0])
