"""Intervals for means of a few episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.errors import BMRLError


def bootstrap_interval(
    values: ArrayLike,
    *,
    strata: ArrayLike | None = None,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    r"""Percentile bootstrap interval of the mean, optionally stratified.

    Every stratum :math:`s` is resampled with replacement on its own, at its own size :math:`n_s`,
    and the statistic is the mean over all values,

    .. math:: \bar x^* = \frac{1}{N} \sum_s \sum_{i=1}^{n_s} x^*_{s,i}.

    With the training seed as the stratum, every resample holds as many episodes of each seed as
    were evaluated: the interval tells how far the mean of these trained policies would move with
    other episodes, not with other seeds.

    Args:
        values: Sample, shape ``(N,)``; returns, or successes as 0 and 1.
        strata: Label of each value's stratum, shape ``(N,)``; ``None`` is one stratum.
        confidence: Coverage asked for, in (0, 1).
        resamples: Number of bootstrap resamples.
        seed: Seed of the resampling; equal arguments give the equal interval.

    Returns:
        Lower and upper end. Where no stratum holds two different values (a single episode, 20 of
        20 successes) resampling cannot move the mean, and both ends are the mean.

    Raises:
        BMRLError: if ``values`` is empty, not a vector or not finite, or ``strata`` or
            ``confidence`` does not fit.

    Example:
        >>> low, high = bootstrap_interval([1.0, 0.0, 1.0, 1.0])
        >>> low < 0.75 < high
        True
        >>> bootstrap_interval([1.0, 1.0, 1.0])
        (1.0, 1.0)
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or sample.size == 0 or not np.isfinite(sample).all():
        raise BMRLError(
            f"a bootstrap interval needs a non-empty vector of finite values, got shape "
            f"{sample.shape} with {int((~np.isfinite(sample)).sum())} non-finite values"
        )
    if not 0.0 < confidence < 1.0:
        raise BMRLError(f"confidence must lie in (0, 1), got {confidence}")
    groups = _split(sample, strata)
    moving = [group for group in groups if np.ptp(group) > 0.0]
    if not moving:
        return float(sample.mean()), float(sample.mean())
    # scipy refuses strata of one value; constant strata add the same sum to every resample.
    fixed = sum(float(group.sum()) for group in groups if np.ptp(group) == 0.0)

    def mean(*resampled: NDArray[np.float64], axis: int) -> Any:
        return (fixed + sum(group.sum(axis=axis) for group in resampled)) / sample.size

    # Imported here: scipy.stats takes a second, and processes that only roll out never need it.
    from scipy.stats import bootstrap

    interval = bootstrap(
        moving,
        mean,
        vectorized=True,
        paired=False,
        confidence_level=confidence,
        n_resamples=resamples,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _split(sample: NDArray[np.float64], strata: ArrayLike | None) -> Sequence[NDArray[np.float64]]:
    """Groups of the sample by stratum, in the order of the labels."""
    if strata is None:
        return [sample]
    labels = np.asarray(strata)
    if labels.shape != sample.shape:
        raise BMRLError(f"strata must have the shape of values {sample.shape}, got {labels.shape}")
    return [sample[labels == label] for label in np.unique(labels)]
