"""What the embedding m knows of a task: its stages, and the distance to its goal.

Distances are measured on transitions up to the first that succeeds (:func:`until_success`), stages
on :data:`STAGE_TAIL` steps more: after that an expert holds still, for most of an episode, and what
an action's noise does there is neither a stage nor a way.

Needs scipy and scikit-learn, of the ``[reports]`` extra.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.statistics import Estimate, bootstrap_interval
from torchrl_bmrl.extras import needs

STAGE_TAIL = 10
"""Steps after success that count as the last stage, half a second.

A task succeeds as soon as its last stage has got far enough: cut there, a lift's last stage is a
third as long as the others.
"""


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """How far the groups that were found in a task agree with its recorded phases.

    Attributes:
        task: its name.
        phases: names of the phases.
        agreement: adjusted mutual information by what the groups were found in.
        episodes: number of held-out episodes.
        transitions: number of their transitions on the way.

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
    """How far distances to a task's success point tell the distance to its goal.

    Attributes:
        task: its name.
        correlation: Spearman's, mean over episodes, by what the distances are taken in.
        lowest: lowest of the episodes' correlations in the embedding.
        spread: of the embeddings at success, over that at the start; ``None`` without two
            successful episodes.
        episodes: number of held-out episodes.
        transitions: number of their transitions on the way.

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
    """Which transitions lie on the way: those up to and with the first that succeeds.

    Args:
        success: Whether a transition meets the task's goal, shape ``(N,)``.
        episode: Episode within the task, shape ``(N,)``, in any order.
        step: Step within the episode, shape ``(N,)``.
        tail: So many steps after the success are on the way, too.

    Returns:
        Mask, shape ``(N,)``. An episode without success is on the way to its end.

    Raises:
        BMRLError: if the shapes do not fit.

    Example:
        >>> until_success([0, 1, 0, 1], episode=[0, 0, 0, 0], step=[0, 1, 2, 3]).tolist()
        [True, True, False, False]
    """
    success, episode, step = np.asarray(success, bool), np.asarray(episode), np.asarray(step)
    _check_rows(len(np.atleast_1d(success)), success=success, episode=episode, step=step)
    on_the_way = np.ones(success.shape, dtype=bool)
    for number in np.unique(episode):
        rows = episode == number
        if success[rows].any():
            on_the_way[rows] = step[rows] <= step[rows & success].min() + tail
    return on_the_way


def find_stages(
    training: ArrayLike, points: ArrayLike, num_stages: int, *, seed: int = 0
) -> NDArray[np.int64]:
    """Groups transitions of a task into stages, without being told any.

    A mixture of Gaussians with full covariances is fitted to the training transitions and names the
    component of each point. Stages are stretched along an episode's way and differ in size, which
    k-means, made for round clusters of one size, cuts across.

    Args:
        training: What the groups are found in, shape ``(M, d)``.
        points: What is grouped, shape ``(N, d)``.
        num_stages: Number of groups.
        seed: Seed of the fit; equal arguments give equal groups.

    Returns:
        Group of each point, shape ``(N,)``, in [0, num_stages). There are fewer groups where fewer
        training points differ.

    Raises:
        BMRLError: if the points are not finite or of differing sizes, or fewer than the groups.

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
    # In units of the points' spread, so that reg_covar means the same for every embedding.
    loc, spread = training.mean(0), float(training.std())
    training, points = (training - loc) / spread, (points - loc) / spread
    groups = min(num_stages, len(np.unique(training, axis=0)))
    mixture = GaussianMixture(groups, n_init=5, reg_covar=1e-5, random_state=seed)
    # Several threads add up in an order that changes from run to run.
    with threadpool_limits(limits=1):
        mixture.fit(training)
        return mixture.predict(points).astype(np.int64)


def is_one_point(points: NDArray[np.floating[Any]]) -> bool:
    """Whether points are all the same but for rounding.

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
    stage: ArrayLike, phase: ArrayLike, episode: ArrayLike, *, resamples: int = 200, seed: int = 0
) -> Estimate:
    """Adjusted mutual information of groups and recorded phases.

    It is 1 where either tells the other, 0 on average where they are drawn independently, whatever
    their numbers and sizes are, and does not look at which group has which name.

    Args:
        stage: Group of each transition, shape ``(N,)``.
        phase: Recorded phase of each transition, shape ``(N,)``.
        episode: Episode of each transition, shape ``(N,)``: what is resampled, as transitions of
            one episode are not independent.
        resamples: Number of bootstrap resamples.
        seed: Seed of the resampling.

    Returns:
        Adjusted mutual information, normalised by the mean entropy, and its interval.

    Raises:
        BMRLError: if there is no transition or the shapes do not fit.

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
        resamples=resamples,
        seed=seed,
    )


def distance_correlations(
    task_latent: ArrayLike, success_point: ArrayLike, distance: ArrayLike, episode: ArrayLike
) -> NDArray[np.float64]:
    """Rank correlation, in each episode, of the distances in the embedding and in the world.

    Args:
        task_latent: Embeddings m, shape ``(N, d)``.
        success_point: Where the task succeeds in the embedding, shape ``(d,)``.
        distance: End effector to goal, shape ``(N,)``, [m].
        episode: Episode of each transition, shape ``(N,)``.

    Returns:
        Spearman's correlation of each episode, in their order, shape ``(E,)``; 0 where an episode
        has a single transition or one of the distances never changes, since nothing is told then.

    Raises:
        BMRLError: if there is no transition, the shapes do not fit or a number is not finite.

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
        raise BMRLError("distance must be finite; it holds NaN or infinite values")
    away = np.linalg.norm(latent - point, axis=1)
    return np.array(
        [_spearman(away[episode == n], distance[episode == n]) for n in np.unique(episode)]
    )


def spread_ratio(
    start: ArrayLike, end: ArrayLike, *, resamples: int = 200, seed: int = 0
) -> Estimate:
    """How far apart episodes end in the embedding, over how far apart they start.

    The spread of points is the root of their mean squared distance from their mean.

    Args:
        start: Embedding of each episode's first transition, shape ``(E, d)``.
        end: Embedding of each episode's first success, shape ``(E, d)``.
        resamples: Number of bootstrap resamples.
        seed: Seed of the resampling.

    Returns:
        Ratio and its interval; below 1 the episodes come together.

    Raises:
        BMRLError: if the shapes do not fit, a number is not finite, or all start in one point.

    Example:
        >>> spread_ratio([[0.0], [4.0]], [[1.0], [2.0]]).value
        0.25
    """
    start, end = _check_points("start", start), _check_points("end", end)
    if start.shape != end.shape:
        raise BMRLError(f"end has the shape {end.shape}; valid: {start.shape}, as start has")

    def ratio(rows: NDArray[np.integer[Any]]) -> float:
        before = _spread(start[rows])
        return _spread(end[rows]) / before if before > 0.0 else np.nan

    if np.isnan(ratio(np.arange(len(start)))):
        raise BMRLError(f"start is one point {len(start)} times; valid: at least two that differ")
    return _over_episodes(ratio, np.arange(len(start)), resamples=resamples, seed=seed)


def mean_estimate(values: ArrayLike, *, seed: int = 0) -> Estimate:
    """Mean over episodes with its interval.

    Args:
        values: One number per episode, shape ``(E,)``.
        seed: Seed of the resampling.

    Raises:
        BMRLError: if there is none, or one is not finite.

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
    resamples: int,
    seed: int,
) -> Estimate:
    """A statistic of rows, and its percentile interval with whole episodes drawn anew."""
    groups = [np.flatnonzero(episode == number) for number in np.unique(episode)]
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(groups), size=(resamples, len(groups)))
    drawn = [statistic(np.concatenate([groups[i] for i in draw])) for draw in draws]
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    value = statistic(np.arange(len(episode)))
    return Estimate(value=value, low=float(low), high=float(high))


def _spearman(first: NDArray[Any], second: NDArray[Any]) -> float:
    if np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return 0.0
    with needs("reports"):
        from scipy.stats import spearmanr

    return float(spearmanr(first, second).statistic)


def _spread(points: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.square(points - points.mean(0)).sum(1).mean()))


def _check_points(name: str, points: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or 0 in array.shape:
        raise BMRLError(f"{name} has the shape {array.shape}; valid: (N, d), neither of them 0")
    if not np.isfinite(array).all():
        raise BMRLError(f"{name} must be finite; it holds NaN or infinite values")
    return array


def _check_rows(count: int, **columns: NDArray[Any]) -> None:
    for name, column in columns.items():
        if column.shape != (count,) or not count:
            valid = f"({count},)" if count else "(N,), N above 0"
            raise BMRLError(f"{name} has the shape {column.shape}; valid: {valid}")
