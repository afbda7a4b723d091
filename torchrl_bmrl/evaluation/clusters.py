"""Intervals for several trained policies that play the same members of a family.

Episodes of one member with one trained policy resemble each other. An interval about other training
seeds and other members therefore counts these, not the episodes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.statistics import Estimate
from torchrl_bmrl.extras import needs

_CONFIDENCE = 0.95


def clustered_ratio(
    x: ArrayLike,
    y: ArrayLike | None = None,
    *,
    runs: ArrayLike,
    members: ArrayLike,
    groups: ArrayLike | None = None,
) -> Estimate:
    r"""Ratio of two means over episodes, with an interval about other runs and other members.

    .. math::
        \rho = \frac{1}{G} \sum_g \frac{\bar x_g}{\bar y_g}, \qquad
        z_{g,r,m} = \frac{\bar x_{g,r,m} - \rho_g \bar y_{g,r,m}}{\bar y_g}

    Every run r plays every member m of its group g, and all of them count the same. The variance of
    :math:`\rho_g` is that of the mean of the linearised :math:`z`: the squared standard error of
    its means by run, plus that of its means by member. Noise of the episodes counts in both, so the
    interval is rather too wide than too narrow. Its ends are quantiles of Student's t, with
    Satterthwaite's degrees of freedom.

    A single run or member says nothing about others. One run gives an interval about members for
    this trained policy; one run with one member gives an interval about episodes. With two runs,
    the interval contains the truth in about 90% of all cases.

    A percentile bootstrap that resamples runs, members and episodes would be too narrow: it has no
    value outside of those measured, so if three runs differ more than members and episodes do, its
    interval contains the truth in at most 75% of all cases.

    Reference: Satterthwaite, *An Approximate Distribution of Estimates of Variance Components*,
    Biometrics Bulletin 1946.

    Args:
        x: values of the episodes, such as returns or differences of two policies' returns,
            ``(N,)``.
        y: what they are divided by, such as the returns of another policy on the same starts,
            ``(N,)``; ``None`` for the mean of ``x``.
        runs: label of each episode's run, a training seed, ``(N,)``.
        members: label of each episode's member, ``(N,)``.
        groups: label of each episode's group, such as a family, ``(N,)``; ``None`` is one group.

    Raises:
        BMRLError: if the values or labels are not vectors of one length or not finite, a run of a
            group lacks a member, or a group's mean of ``y`` is not positive.

    Example:
        >>> seeds, members = [0, 0, 1, 1], ["a", "b", "a", "b"]
        >>> print(clustered_ratio([0.9, 0.8, 1.0, 0.9], runs=seeds, members=members))
        0.90 [0.60, 1.20]
    """
    x = np.asarray(x, dtype=np.float64)
    y = np.ones_like(x) if y is None else np.asarray(y, dtype=np.float64)
    labels = [np.zeros(x.shape, int) if groups is None else groups, runs, members]
    group, run, member = (np.asarray(each) for each in labels)
    for name, each in {"x": x, "y": y, "groups": group, "runs": run, "members": member}.items():
        if each.ndim != 1 or not each.size or each.shape != x.shape:
            raise BMRLError(f"{name} has shape {each.shape}; valid: that of x, (N,) with N > 0")
        if each.dtype == np.float64 and not np.isfinite(each).all():
            raise BMRLError(f"{name} has values that are not finite; valid: finite ones")
    ratios, terms = [], []
    for label in np.unique(group):
        rows = group == label
        ratio, variances = _ratio(x[rows], y[rows], run[rows], member[rows])
        ratios.append(ratio)
        terms += variances
    value, variance = float(np.mean(ratios)), sum(each for each, _ in terms)
    if not variance > 0.0:
        return Estimate(value=value, low=value, high=value)
    with needs("reports"):
        from scipy.special import stdtrit
    freedom = variance**2 / sum(each**2 / size for each, size in terms)
    quantile = float(stdtrit(freedom, 0.5 + _CONFIDENCE / 2))
    width = quantile * math.sqrt(variance) / len(ratios)
    return Estimate(value=value, low=value - width, high=value + width)


def _ratio(
    x: NDArray[np.float64], y: NDArray[np.float64], runs: NDArray[Any], members: NDArray[Any]
) -> tuple[float, list[tuple[float, int]]]:
    """The ratio of one group, and squared standard errors with their degrees of freedom."""
    names, row = np.unique(runs, return_inverse=True)
    others, column = np.unique(members, return_inverse=True)
    counts = np.zeros((len(names), len(others)))
    np.add.at(counts, (row, column), 1.0)
    if not counts.all():
        i, j = np.argwhere(counts == 0)[0]
        raise BMRLError(f"run {names[i]} has no episode of {others[j]}; valid: all members")

    def cells(values: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.zeros_like(counts)
        np.add.at(total, (row, column), values)
        return total / counts

    scale = cells(y).mean()
    if not scale > 0.0:
        raise BMRLError(f"the mean of y is {scale}; valid: above 0")
    ratio = float(cells(x).mean() / scale)
    z = (x - ratio * y) / scale
    linear = cells(z)
    sides = [side for side in (linear.mean(1), linear.mean(0)) if len(side) > 1]
    samples = sides or ([z] if len(z) > 1 else [])
    return ratio, [(float(s.var(ddof=1)) / len(s), len(s) - 1) for s in samples]
