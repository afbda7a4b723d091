"""Bootstrap intervals of means over episodes and of differences between two policies."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs

RESAMPLES = 2000
"""Number of bootstrap resamples."""
_CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A measured number with its 95% bootstrap interval over episodes.

    Attributes:
        value: the number.
        low: lower end of the interval.
        high: upper end of the interval.

    Example:
        >>> print(Estimate(value=0.5, low=0.4, high=0.6))
        0.50 [0.40, 0.60]
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """Returns the number and its interval as tables print them."""
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


def bootstrap_interval(
    values: ArrayLike,
    *,
    strata: ArrayLike | None = None,
    seed: int = 0,
) -> tuple[float, float]:
    r"""Computes the 95% percentile bootstrap interval of the mean, optionally stratified.

    Each stratum :math:`s` is resampled with replacement at its own size :math:`n_s`, and the
    statistic is the mean over all values,

    .. math:: \bar x^* = \frac{1}{N} \sum_s \sum_{i=1}^{n_s} x^*_{s,i}.

    With the training seed as the stratum, the interval shows how far the mean of these trained
    policies would move with other episodes, not with other training seeds.

    Args:
        values: Sample, shape ``(N,)``; returns, or successes as 0 and 1.
        strata: Label of each value's stratum, shape ``(N,)``; ``None`` is one stratum.
        seed: Seed of the resampling.

    Returns:
        Lower and upper end. Both are the mean if no stratum contains two different values (a
        single episode, 20 of 20 successes), because resampling cannot move the mean then.

    Raises:
        BMRLError: if ``values`` is empty, not a vector or not finite, or ``strata`` has another
            shape.

    Example:
        >>> low, high = bootstrap_interval([1.0, 0.0, 1.0, 1.0])
        >>> low < 0.75 < high
        True
        >>> bootstrap_interval([1.0, 1.0, 1.0])
        (1.0, 1.0)
    """
    sample = _vector("values", values)
    groups = [sample[rows] for rows in _split(len(sample), strata)]
    moving = [group for group in groups if np.ptp(group) > 0.0]
    if not moving:
        return float(sample.mean()), float(sample.mean())
    # scipy refuses strata of one value; a constant stratum adds the same sum to every resample.
    fixed = sum(float(group.sum()) for group in groups if np.ptp(group) == 0.0)

    def mean(*resampled: NDArray[np.float64], axis: int) -> Any:
        return (fixed + sum(group.sum(axis=axis) for group in resampled)) / sample.size

    return _percentiles(moving, mean, seed=seed)


def relative_difference(
    x: ArrayLike,
    y: ArrayLike,
    *,
    strata: ArrayLike | None = None,
    groups: ArrayLike | None = None,
) -> Estimate:
    r"""Relative difference of two policies' mean returns on the same starts.

    .. math:: \delta = \frac{1}{G} \sum_g \frac{\bar x_g - \bar y_g}{\bar y_g}

    There is one group, or one group per task; then the result is the mean over tasks.

    The interval is a 95% percentile bootstrap over pairs: ``x[i]`` and ``y[i]`` are episodes from
    the same start and are drawn together, so that a difficult start does not count as a
    difference. Each stratum of a group is resampled at its own size, as in
    :func:`bootstrap_interval`. A resample in which a group's mean of ``y`` is not positive has no
    relative difference and is left out.

    Args:
        x: Returns of the first policy, shape ``(N,)``.
        y: Returns of the second policy on the same starts in the same order, shape ``(N,)``.
        strata: Label of each pair's stratum, the training seed, shape ``(N,)``.
        groups: Label of each pair's group, shape ``(N,)``; ``None`` is one group.

    Raises:
        BMRLError: if the values are not two finite vectors of the same length, a group's mean of
            ``y`` is not positive, or the labels have another shape.

    Example:
        >>> relative_difference([110.0, 220.0], [100.0, 200.0])
        Estimate(value=0.1, low=0.1, high=0.1)
    """
    ours, theirs = _vector("x", x), _vector("y", y)
    if len(ours) != len(theirs):
        raise BMRLError(f"x and y are pairs; got {len(ours)} and {len(theirs)} values")
    layers = _split(len(ours), strata)
    parts = []  # per group, the rows of its strata, sorted so that the given order has no effect
    for rows in _split(len(ours), groups):
        split = [part for layer in layers if len(part := np.intersect1d(rows, layer))]
        parts.append([part[np.lexsort((theirs[part], ours[part]))] for part in split])
        if not theirs[rows].mean() > 0.0:
            raise BMRLError(f"the mean of y is {theirs[rows].mean()}; valid: above 0")

    def difference(*resampled: NDArray[np.int64], axis: int) -> Any:
        drawn = iter(resampled)
        ratios = []
        for group in parts:
            index = [part[next(drawn)] for part in group]
            total = sum(theirs[rows].sum(axis=axis) for rows in index)
            gain = sum((ours[rows] - theirs[rows]).sum(axis=axis) for rows in index)
            ratios.append(gain / np.where(total > 0.0, total, np.nan))
        return sum(ratios) / len(ratios)

    sizes = [len(part) for group in parts for part in group]
    return _estimate(sizes, difference)


def probability_of_improvement(
    x: ArrayLike,
    y: ArrayLike,
    *,
    x_strata: ArrayLike | None = None,
    y_strata: ArrayLike | None = None,
) -> Estimate:
    r"""Probability of improvement: how often an episode of one policy returns more than another's.

    .. math::
        P(X > Y) = \frac{1}{S} \sum_s \frac{1}{n_s m_s} \sum_{i, j}
        [x_{s,i} > y_{s,j}] + \tfrac{1}{2} [x_{s,i} = y_{s,j}]

    The interval is a 95% percentile bootstrap that resamples the episodes of both policies
    independently in each stratum. If both start from the same states, it is wider than necessary.

    Reference: Agarwal et al. 2021, https://arxiv.org/abs/2108.13264, section 4.3.

    Args:
        x: Returns of the first policy, shape ``(N,)``.
        y: Returns of the second policy, shape ``(M,)``.
        x_strata: Label of each value's stratum, the training seed, shape ``(N,)``.
        y_strata: The same for ``y``, with the same set of labels, shape ``(M,)``.

    Raises:
        BMRLError: if the values are not finite vectors, or the strata differ.

    Example:
        >>> probability_of_improvement([3.0, 4.0], [1.0, 2.0])
        Estimate(value=1.0, low=1.0, high=1.0)
        >>> probability_of_improvement([1.0, 1.0], [1.0, 1.0]).value
        0.5
    """
    ours, theirs = _vector("x", x), _vector("y", y)
    seeds = [
        [] if labels is None else np.unique(np.asarray(labels)).tolist()
        for labels in (x_strata, y_strata)
    ]
    if seeds[0] != seeds[1]:
        raise BMRLError(f"the strata of x are {seeds[0]}, those of y {seeds[1]}; valid: the same")
    groups = [
        [np.sort(values[rows]) for rows in _split(len(values), labels)]
        for values, labels in ((ours, x_strata), (theirs, y_strata))
    ]
    # A resample's probability depends only on how often each episode is drawn.
    wins = [
        np.greater.outer(mine, others) + 0.5 * np.equal.outer(mine, others)
        for mine, others in zip(*groups, strict=True)
    ]

    def probability(*resampled: NDArray[np.int64], axis: int) -> Any:
        drawn = iter(resampled)
        shares = []
        for win in wins:
            a, b = (_counts(next(drawn), size) for size in win.shape)
            shares.append(((a @ win) * b).sum(axis=axis) / win.size)
        return sum(shares) / len(shares)

    sizes = [size for win in wins for size in win.shape]
    return _estimate(sizes, probability)


def rank_correlation(
    x: ArrayLike,
    y: ArrayLike,
    *,
    groups: ArrayLike | None = None,
) -> Estimate:
    r"""Spearman's rank correlation of two measures of the same policies.

    .. math::
        \rho = \frac{1}{G} \sum_g \mathrm{corr}\big(\mathrm{rank}(x_g), \mathrm{rank}(y_g)\big)

    There is one group, or one group per task; then ranks are taken within a task and the result
    is the mean over tasks. Equal values share their mean rank. A group in which all of ``x`` or
    all of ``y`` are equal counts as 0. The interval is a 95% percentile bootstrap over the pairs
    of each group.

    Reference: Spearman, *The Proof and Measurement of Association between Two Things*, American
    Journal of Psychology 1904.

    Args:
        x: First measure of each policy, such as an estimate of its return, shape ``(N,)``.
        y: Second measure, such as its return, in the same order, shape ``(N,)``.
        groups: Label of each policy's group, shape ``(N,)``; ``None`` is one group.

    Raises:
        BMRLError: if the values are not two finite vectors of the same length, or the labels have
            another shape.

    Example:
        >>> print(rank_correlation([0.1, 0.2, 0.3], [10.0, 20.0, 20.0]))
        0.87 [0.00, 1.00]
    """
    with needs("reports"):
        from scipy.stats import rankdata

    ours, theirs = _vector("x", x), _vector("y", y)
    if len(ours) != len(theirs):
        raise BMRLError(f"x and y are pairs; got {len(ours)} and {len(theirs)} values")
    parts = _split(len(ours), groups)

    def correlation(*resampled: NDArray[np.int64], axis: int) -> Any:
        total: Any = 0.0
        for rows, drawn in zip(parts, resampled, strict=True):
            ranks = [rankdata(values[rows][drawn], axis=-1) for values in (ours, theirs)]
            a, b = (rank - rank.mean(-1, keepdims=True) for rank in ranks)
            norm = np.sqrt((a * a).sum(-1) * (b * b).sum(-1))
            total = total + (a * b).sum(-1) / np.where(norm > 0, norm, 1.0)
        return total / len(parts)

    sizes = [len(rows) for rows in parts]
    return _estimate(sizes, correlation)


def _estimate(sizes: Sequence[int], statistic: Callable[..., Any]) -> Estimate:
    """Evaluates a statistic of index vectors of the given sizes, with its bootstrap interval."""
    whole = [np.arange(size) for size in sizes]
    value = float(statistic(*whole, axis=-1))
    moving = [index for index in whole if len(index) > 1]

    def resampled(*drawn: NDArray[np.int64], axis: int) -> Any:
        rest = iter(drawn)
        # scipy refuses samples of one value, which are the same in every resample.
        return statistic(*(next(rest) if size > 1 else np.zeros(1, int) for size in sizes), axis=-1)

    low, high = _percentiles(moving, resampled) if moving else (value, value)
    return Estimate(value=value, low=low, high=high)


def _percentiles(
    samples: Sequence[NDArray[Any]], statistic: Callable[..., Any], *, seed: int = 0
) -> tuple[float, float]:
    """Computes scipy's percentile bootstrap of samples that are resampled independently."""
    # Imported here because it takes a second, and a process that only plays episodes needs none.
    with needs("reports"):
        from scipy.stats import DegenerateDataWarning, bootstrap

    with warnings.catch_warnings():  # about resamples that are left out below
        warnings.simplefilter("ignore", DegenerateDataWarning)
        result = bootstrap(
            samples,
            statistic,
            vectorized=True,
            paired=False,
            confidence_level=_CONFIDENCE,
            n_resamples=RESAMPLES,
            method="percentile",
            rng=np.random.default_rng(seed),
        )
    low, high = result.confidence_interval
    drawn = result.bootstrap_distribution
    if np.isnan(drawn).any():
        drawn = drawn[~np.isnan(drawn)]
        if not drawn.size:
            raise BMRLError(f"none of {RESAMPLES} resamples has a number; valid: more episodes")
        outside = (1.0 - _CONFIDENCE) / 2.0
        low, high = np.quantile(drawn, [outside, 1.0 - outside])
    return float(low), float(high)


def _counts(rows: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    """Counts how often each of ``size`` rows is drawn, shape ``(*B, n)`` to ``(*B, size)``."""
    offsets = size * np.arange(rows.size // rows.shape[-1])
    flat = rows.reshape(-1, rows.shape[-1]) + offsets[:, None]
    counts = np.bincount(flat.ravel(), minlength=size * len(offsets))
    return counts.reshape(*rows.shape[:-1], size).astype(np.float64)


def _vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0 or not np.isfinite(sample).all():
        raise BMRLError(
            f"a bootstrap interval needs a non-empty vector of finite {name}, got shape "
            f"{sample.shape} with {int((~np.isfinite(sample)).sum())} non-finite values"
        )
    return sample


def _split(size: int, strata: ArrayLike | None) -> list[NDArray[np.int64]]:
    """Returns the rows of each stratum, in the order of the labels."""
    if strata is None:
        return [np.arange(size)]
    labels = np.asarray(strata)
    if labels.shape != (size,):
        raise BMRLError(f"strata must have the shape of values {(size,)}, got {labels.shape}")
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]
