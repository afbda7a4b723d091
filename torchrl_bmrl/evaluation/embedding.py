"""Measures of the task embedding m: stages of a task, and distance to its goal.

Distances are measured on transitions up to the first success (:func:`until_success`), stages on
:data:`STAGE_TAIL` steps more. After that an expert holds still for most of an episode, and its
action noise is neither a stage nor progress.

Needs scipy and scikit-learn from the ``[reports]`` extra.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.behaviour import spread
from torchrl_bmrl.evaluation.statistics import Estimate, bootstrap_interval
from torchrl_bmrl.extras import needs

STAGE_TAIL = 10
"""Steps after success that still belong to the last stage (half a second at 20 Hz).

A task succeeds in the middle of its last stage. Without these steps, the last stage of a lift would
be a third as long as the others.
"""

_RESAMPLES = 200


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """Agreement of the groups found in a task's transitions with its recorded phases.

    Attributes:
        task: name of the task.
        phases: names of the phases.
        agreement: adjusted mutual information by representation.
        episodes: number of held-out episodes.
        transitions: number of their transitions.

    Example:
        >>> result = StageResult(
        ...     task="lift",
        ...     phases=("descend", "grasp", "lift"),
        ...     agreement={"embedding": Estimate(value=0.8, low=0.7, high=0.9)},
        ...     episodes=1,
        ...     transitions=2,
        ... )
        >>> print(result.agreement["embedding"])
        0.80 [0.70, 0.90]
    """

    task: str
    phases: Sequence[str]
    agreement: Mapping[str, Estimate]
    episodes: int
    transitions: int


@dataclass(frozen=True, kw_only=True)
class GoalDistanceResult:
    """Correlation of the distance to a task's success point with the distance to its goal.

    Attributes:
        task: name of the task.
        correlation: Spearman's correlation, mean over episodes, by representation.
        lowest: lowest of the episodes' correlations in the embedding.
        spread: spread of the embeddings at success divided by their spread at the start; ``None``
            if fewer than two episodes succeed.
        episodes: number of held-out episodes.
        transitions: number of their transitions up to success.

    Example:
        >>> result = GoalDistanceResult(
        ...     task="reach",
        ...     correlation={"embedding": Estimate(value=0.9, low=0.8, high=1.0)},
        ...     lowest=0.9,
        ...     spread=None,
        ...     episodes=2,
        ...     transitions=80,
        ... )
        >>> print(result.correlation["embedding"])
        0.90 [0.80, 1.00]
    """

    task: str
    correlation: Mapping[str, Estimate]
    lowest: float
    spread: Estimate | None
    episodes: int
    transitions: int


def until_success(
    success: ArrayLike, episode: ArrayLike, step: ArrayLike, *, tail: int = 0
) -> NDArray[np.bool_]:
    """Selects the transitions of each episode up to and including its first success.

    Args:
        success: Whether a transition meets the task's goal, shape ``(N,)``.
        episode: Episode within the task, shape ``(N,)``, in any order.
        step: Step within the episode, shape ``(N,)``.
        tail: Number of steps after the success that are also selected.

    Returns:
        Mask, shape ``(N,)``. All of an episode without success is selected.

    Raises:
        BMRLError: if the shapes differ.

    Example:
        >>> until_success([0, 1, 0, 1], episode=[0, 0, 0, 0], step=[0, 1, 2, 3]).tolist()
        [True, True, False, False]
    """
    success, episode, step = np.asarray(success, bool), np.asarray(episode), np.asarray(step)
    _check_rows(len(np.atleast_1d(success)), success=success, episode=episode, step=step)
    selected = np.ones(success.shape, dtype=bool)
    for number in np.unique(episode):
        rows = episode == number
        if success[rows].any():
            selected[rows] = step[rows] <= step[rows & success].min() + tail
    return selected


def find_stages(
    training: ArrayLike, points: ArrayLike, num_stages: int, *, seed: int = 0
) -> NDArray[np.int64]:
    """Groups transitions of a task into stages, without labels.

    A mixture of Gaussians with full covariances is fitted to the training transitions, and each
    point gets its most likely component. Stages are stretched along the trajectory and differ in
    size; k-means assumes round clusters of one size and would cut across them.

    Args:
        training: Transitions that the mixture is fitted to, shape ``(M, d)``.
        points: Transitions that are grouped, shape ``(N, d)``.
        num_stages: Number of groups.
        seed: Seed of the fit.

    Returns:
        Group of each point, shape ``(N,)``, in [0, num_stages). There are fewer groups if there are
        fewer distinct training points.

    Raises:
        BMRLError: if the points are not finite, differ in size, or are fewer than the groups.

    Example:
        >>> line = np.array([[0.0], [0.1], [0.2], [5.0], [5.1], [5.2]])
        >>> first, last = find_stages(line, [[0.1], [5.1]], 2)
        >>> bool(first != last)
        True
    """
    with needs("reports"):
        from sklearn.mixture import GaussianMixture
        from threadpoolctl import threadpool_limits

    training, points = _check_points("training", training), _check_points("points", points)
    if training.shape[1] != points.shape[1]:
        raise BMRLError(
            f"points have the size {points.shape[1]}; valid: {training.shape[1]}, as in training"
        )
    if not 1 <= num_stages <= len(training):
        raise BMRLError(
            f"num_stages is {num_stages}; valid: 1 to {len(training)}, one for each transition"
        )
    if is_one_point(training):
        return np.zeros(len(points), dtype=np.int64)
    # Scaled by the points' spread, so that reg_covar has the same effect for every embedding.
    loc, scale = training.mean(0), float(training.std())
    training, points = (training - loc) / scale, (points - loc) / scale
    groups = min(num_stages, len(np.unique(training, axis=0)))
    mixture = GaussianMixture(groups, n_init=5, reg_covar=1e-5, random_state=seed)
    # With several threads the order of sums, and so the result, would vary from run to run.
    with threadpool_limits(limits=1):
        mixture.fit(training)
        return mixture.predict(points).astype(np.int64)


def is_one_point(points: NDArray[np.floating[Any]]) -> bool:
    """Whether all points are equal up to rounding.

    Args:
        points: shape ``(N, d)``.

    Example:
        >>> is_one_point(np.array([[0.1, 0.2], [0.1, 0.2 + 1e-17]]))
        True
    """
    if len(points) < 2:
        return True
    return float(np.ptp(points, axis=0).max()) <= 1e-12 * float(np.abs(points).max())


def stage_agreement(
    stage: ArrayLike, phase: ArrayLike, episode: ArrayLike, *, seed: int = 0
) -> Estimate:
    """Adjusted mutual information of groups and recorded phases.

    It is 1 if groups and phases are the same division and 0 on average if they are independent, for
    any number and size of groups. It does not depend on the groups' numbering.

    Args:
        stage: Group of each transition, shape ``(N,)``.
        phase: Recorded phase of each transition, shape ``(N,)``.
        episode: Episode of each transition, shape ``(N,)``. Episodes are resampled, because
            transitions of one episode are not independent.
        seed: Seed of the resampling.

    Returns:
        Adjusted mutual information, normalised by the mean entropy, and its interval.

    Raises:
        BMRLError: if there is no transition or the shapes differ.

    Example:
        >>> print(stage_agreement([1, 1, 0, 0], [0, 0, 2, 2], episode=[0, 1, 0, 1]))
        1.00 [1.00, 1.00]
    """
    with needs("reports"):
        from sklearn.metrics import adjusted_mutual_info_score

    stage, phase, episode = np.asarray(stage), np.asarray(phase), np.asarray(episode)
    _check_rows(stage.size, stage=stage, phase=phase, episode=episode)
    return _over_episodes(
        lambda rows: float(adjusted_mutual_info_score(phase[rows], stage[rows])),
        episode,
        seed=seed,
    )


def distance_correlations(
    task_latent: ArrayLike, success_point: ArrayLike, distance: ArrayLike, episode: ArrayLike
) -> NDArray[np.float64]:
    """Rank correlation, in each episode, of distances in the embedding and distances to the goal.

    Args:
        task_latent: Embeddings m, shape ``(N, d)``.
        success_point: Point of the embedding where the task succeeds, shape ``(d,)``.
        distance: Distance to the goal, shape ``(N,)``, [m].
        episode: Episode of each transition, shape ``(N,)``.

    Returns:
        Spearman's correlation of each episode, in their order, shape ``(E,)``. It is 0 if an
        episode has a single transition or one of the distances is constant.

    Raises:
        BMRLError: if there is no transition, the shapes differ or a number is not finite.

    Example:
        >>> way = np.array([[3.0, 0.0], [0.0, 2.0], [0.5, 0.0]])
        >>> distance_correlations(way, [0.0, 0.0], [0.3, 0.1, 0.02], [0, 0, 0]).tolist()
        [1.0]
    """
    latent, distance = _check_points("task_latent", task_latent), np.asarray(distance)
    point, episode = np.asarray(success_point, dtype=np.float64), np.asarray(episode)
    _check_rows(len(latent), distance=distance, episode=episode)
    if point.shape != latent.shape[1:] or not np.isfinite(point).all():
        raise BMRLError(
            f"success_point is {point.tolist()}; valid: {latent.shape[1]} finite numbers, as many "
            "as an embedding has"
        )
    if not np.isfinite(distance).all():
        raise BMRLError("distance must be finite; it contains NaN or infinite values")
    away = np.linalg.norm(latent - point, axis=1)
    return np.array(
        [_spearman(away[episode == n], distance[episode == n]) for n in np.unique(episode)]
    )


def spread_ratio(start: ArrayLike, end: ArrayLike, *, seed: int = 0) -> Estimate:
    """Spread of episodes in the embedding at their end divided by the spread at their start.

    The spread of points is the root mean square distance from their mean.

    Args:
        start: Embedding of each episode's first transition, shape ``(E, d)``.
        end: Embedding of each episode's first success, shape ``(E, d)``.
        seed: Seed of the resampling.

    Returns:
        Ratio and its interval; below 1 the episodes converge.

    Raises:
        BMRLError: if the shapes differ, a number is not finite, or all start in one point.

    Example:
        >>> spread_ratio([[0.0], [4.0]], [[1.0], [2.0]]).value
        0.25
    """
    start, end = _check_points("start", start), _check_points("end", end)
    if start.shape != end.shape:
        raise BMRLError(f"end has the shape {end.shape}; valid: {start.shape}, as start has")

    def ratio(rows: NDArray[np.integer[Any]]) -> float:
        before = spread(start[rows])
        return spread(end[rows]) / before if before > 0.0 else np.nan

    if np.isnan(ratio(np.arange(len(start)))):
        raise BMRLError(f"start is one point {len(start)} times; valid: at least two that differ")
    return _over_episodes(ratio, np.arange(len(start)), seed=seed)


def mean_estimate(values: ArrayLike, *, seed: int = 0) -> Estimate:
    """Mean over episodes with its bootstrap interval.

    Args:
        values: One number per episode, shape ``(E,)``.
        seed: Seed of the resampling.

    Raises:
        BMRLError: if there is no number, or one is not finite.

    Example:
        >>> print(mean_estimate([0.5, 0.5]))
        0.50 [0.50, 0.50]
    """
    low, high = bootstrap_interval(values, seed=seed)
    return Estimate(value=float(np.mean(np.asarray(values))), low=low, high=high)


def _over_episodes(
    statistic: Callable[[NDArray[np.integer[Any]]], float],
    episode: NDArray[np.integer[Any]],
    *,
    seed: int,
) -> Estimate:
    """Evaluates a statistic of rows, with a percentile interval over resampled episodes.

    The statistic must not depend on the rows' order.
    """
    groups = [np.flatnonzero(episode == number) for number in np.unique(episode)]
    rng = np.random.default_rng(seed)
    draws = np.sort(rng.integers(len(groups), size=(_RESAMPLES, len(groups))), axis=1)
    # Few episodes have few combinations, which are drawn again and again.
    draws, times = np.unique(draws, axis=0, return_counts=True)
    drawn = [statistic(np.concatenate([groups[i] for i in draw])) for draw in draws]
    low, high = np.nanquantile(np.repeat(drawn, times), [0.025, 0.975])
    value = statistic(np.arange(len(episode)))
    return Estimate(value=value, low=float(low), high=float(high))


def _spearman(first: NDArray[Any], second: NDArray[Any]) -> float:
    if np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return 0.0
    with needs("reports"):
        from scipy.stats import spearmanr

    return float(spearmanr(first, second).statistic)


def _check_points(name: str, points: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or 0 in array.shape:
        raise BMRLError(f"{name} has the shape {array.shape}; valid: (N, d), neither of them 0")
    if not np.isfinite(array).all():
        raise BMRLError(f"{name} must be finite; it contains NaN or infinite values")
    return array


def _check_rows(count: int, **columns: NDArray[Any]) -> None:
    for name, column in columns.items():
        if column.shape != (count,) or not count:
            valid = f"({count},)" if count else "(N,), N above 0"
            raise BMRLError(f"{name} has the shape {column.shape}; valid: {valid}")
