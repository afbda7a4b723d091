"""Differences between two policies that act from the same starts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.results import ResultRow
from torchrl_bmrl.evaluation.statistics import Estimate, bootstrap_interval

Arm = tuple[str, str]
"""A policy and its source of m, which is empty for all but the distilled policy."""
EXPERT: Arm = ("expert", "")


def paired_difference(
    rows: Iterable[ResultRow], x: Arm, y: Arm, tasks: Sequence[str]
) -> Estimate | None:
    r"""Computes the mean difference of two policies' returns as a share of the expert's return.

    .. math:: \frac{1}{G} \sum_g \frac{1}{n_g} \sum_i \frac{x_{g,i} - y_{g,i}}{\bar e_g}

    over the tasks g, where :math:`x_{g,i}` and :math:`y_{g,i}` are returns from the same start and
    :math:`\bar e_g` is the expert's mean return. Episodes are paired by task, training seed and
    number, so the rows of several runs may be put together: starts of different seeds differ.

    The interval is a 95% percentile bootstrap over the pairs of each task and training seed. It is
    about these trained policies, and takes the expert's mean return as known.

    Args:
        rows: episodes of both policies and of the expert; others are ignored.
        x: the first policy.
        y: the second policy, the reference.
        tasks: names of the tasks.

    Returns:
        the difference; ``None`` if on one of the tasks the policies share no start, or the expert
        has no positive mean return.

    Raises:
        BMRLError: if a policy has two episodes of one task, seed and number, as those of two runs
            with the same seed.

    Example:
        >>> rows = [
        ...     ResultRow(task="lift", policy=p, seed=0, episode=i, episode_return=r, success=True)
        ...     for p, returns in {"bcq": (8, 9), "bc": (6, 7), "expert": (10, 10)}.items()
        ...     for i, r in enumerate(returns)
        ... ]
        >>> paired_difference(rows, ("bcq", ""), ("bc", ""), ["lift"])
        Estimate(value=0.2, low=0.2, high=0.2)
    """
    rows = list(rows)
    ours, theirs = _returns(rows, x, tasks), _returns(rows, y, tasks)
    pairs = sorted(ours.keys() & theirs.keys())
    experts = sorted(_returns(rows, EXPERT, tasks).items())
    values, strata = [], []
    for task in tasks:
        mine = [key for key in pairs if key[0] == task]
        scale = np.mean([e for key, e in experts if key[0] == task] or [0.0])
        if not mine or not scale > 0.0:
            return None
        # Weighted so that the mean over all pairs is the mean over tasks.
        weight = len(pairs) / (len(tasks) * len(mine) * scale)
        values += [weight * (ours[key] - theirs[key]) for key in mine]
        strata += [f"{task}/{seed}" for _, seed, _ in mine]
    low, high = bootstrap_interval(values, strata=strata)
    return Estimate(value=float(np.mean(values)), low=low, high=high)


def _returns(
    rows: Sequence[ResultRow], arm: Arm, tasks: Sequence[str]
) -> dict[tuple[str, int, int], float]:
    """Collects the returns of a policy by task, training seed and number of the episode."""
    found: dict[tuple[str, int, int], float] = {}
    for row in rows:
        if (row.policy, row.latent_source) == arm and row.task in tasks:
            key = (row.task, row.seed, row.episode)
            if key in found:
                raise BMRLError(
                    f"{arm[0]} has two episodes {row.episode} of {row.task} with seed {row.seed}; "
                    "valid: runs with different seeds"
                )
            found[key] = row.episode_return
    return found
