"""Measures of a set of episodes: space covered, speed, and outcomes for the cube."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.envs.skills import PUSH_DIRECTIONS
from torchrl_bmrl.errors import BMRLError

LIFTED = 0.05
"""Height above its start at which a cube counts as lifted [m], as in the lift task."""
MOVED = 0.02
"""Distance along the table from its start at which a cube counts as moved [m]."""
CUBE_OUTCOMES = ("still", "lifted", *PUSH_DIRECTIONS)
"""Possible outcomes for the cube."""


def occupied_cells(positions: ArrayLike, cell_size: float) -> NDArray[np.int64]:
    """Returns the cells of a fixed grid that contain a position; a corner is at the origin.

    Args:
        positions: shape ``(..., d)`` [m].
        cell_size: edge of a cell [m].

    Returns:
        indices of the cells in lexicographic order, shape ``(cells, d)``.

    Raises:
        BMRLError: if the size is not positive or a position not finite.

    Example:
        >>> occupied_cells([[0.01, 0.0], [0.03, 0.0], [0.05, -0.01]], 0.04).tolist()
        [[0, 0], [1, -1]]
    """
    if not cell_size > 0:
        raise BMRLError(f"cell_size is {cell_size}; valid: above 0")
    array = _finite(positions, "positions")
    cells = np.floor(array.reshape(-1, array.shape[-1]) / cell_size).astype(np.int64)
    return np.unique(cells, axis=0)


def group_coverage(
    positions: ArrayLike, cell_size: float, *, group_size: int, seed: int = 0
) -> NDArray[np.int64]:
    """Counts the cells that the episodes of a group occupy together, for random disjoint groups.

    The count over all episodes has no valid bootstrap interval, because an episode that is drawn
    twice adds nothing. The mean over disjoint groups has one.

    Args:
        positions: positions of each episode over time, shape ``(N, T, d)`` [m].
        cell_size: edge of a cell [m].
        group_size: number of episodes in a group; a remainder is left out.
        seed: seed of the draw. The groups depend on it and N alone, so that policies with equal N
            are grouped alike.

    Returns:
        shape ``(N // group_size,)``.

    Raises:
        BMRLError: if there is no whole group, and in the cases of :func:`occupied_cells`.

    Example:
        >>> positions = np.zeros((4, 10, 3))
        >>> positions[:, 5:, 0] = 1.0
        >>> group_coverage(positions, 0.1, group_size=2).tolist()
        [2, 2]
    """
    array = _finite(positions, "positions")
    if array.ndim != 3 or not 1 <= group_size <= len(array):
        raise BMRLError(
            f"positions have shape {array.shape}, groups {group_size} episodes; valid: (N, T, d) "
            "with N of at least a group"
        )
    order = np.random.default_rng(seed).permutation(len(array))
    groups = order[: len(order) // group_size * group_size].reshape(-1, group_size)
    return np.array([len(occupied_cells(array[group], cell_size)) for group in groups])


def spread(points: ArrayLike) -> float:
    r"""Root mean square distance of points from their mean, in the points' unit.

    .. math:: \sqrt{\tfrac{1}{N} \sum_i \lVert x_i - \bar x \rVert^2}

    Args:
        points: shape ``(N, d)``.

    Raises:
        BMRLError: if there is no point, or one is not finite.

    Example:
        >>> spread([[0.0, 0.0], [0.0, 2.0]])
        1.0
    """
    array = _finite(points, "points")
    return float(np.sqrt(np.square(array - array.mean(0)).sum(-1).mean()))


def mean_speed(positions: ArrayLike, seconds: float) -> NDArray[np.float64]:
    """Mean speed of each episode: the length of its path divided by its duration.

    Args:
        positions: shape ``(N, T, d)``, T of at least 2 [m].
        seconds: time between two positions [s].

    Returns:
        shape ``(N,)`` [m/s].

    Raises:
        BMRLError: if a path has fewer than two positions or one is not finite.

    Example:
        >>> mean_speed([[[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]]], 0.05).tolist()
        [2.0]
    """
    array = _finite(positions, "positions")
    if array.ndim != 3 or array.shape[1] < 2:
        raise BMRLError(f"positions have shape {array.shape}; valid: (N, T, d) with T of 2 or more")
    return np.linalg.norm(np.diff(array, axis=1), axis=-1).mean(-1) / seconds


def cube_outcomes(displacement: ArrayLike) -> list[str]:
    """Outcome for the cube in each episode, one of :data:`CUBE_OUTCOMES`.

    It is ``lifted`` if the cube is :data:`LIFTED` above its start at some step. Otherwise it is the
    push direction along which the cube ends farthest from its start, or ``still`` if the cube ends
    within :data:`MOVED` of its start.

    Args:
        displacement: the cube's position relative to its start, shape ``(N, T, 3)`` [m].

    Raises:
        BMRLError: for another shape, or displacements that are not finite.

    Example:
        >>> displacement = np.zeros((3, 5, 3))
        >>> displacement[0, 2, 2] = 0.06
        >>> displacement[1, :, 1] = -0.04
        >>> cube_outcomes(displacement)
        ['lifted', 'right', 'still']
    """
    array = _finite(displacement, "displacement")
    if array.ndim != 3 or array.shape[-1] != 3 or not array.shape[1]:
        raise BMRLError(f"displacement has shape {array.shape}; valid: (N, T, 3)")
    names = list(PUSH_DIRECTIONS)
    along = array[:, -1] @ np.array([PUSH_DIRECTIONS[name] for name in names]).T
    moved = [
        names[int(row.argmax())] if np.linalg.norm(end[:2]) > MOVED else "still"
        for row, end in zip(along, array[:, -1], strict=True)
    ]
    lifted = array[..., 2].max(-1) > LIFTED
    return ["lifted" if up else name for up, name in zip(lifted, moved, strict=True)]


def effective_number(outcomes: Iterable[Hashable]) -> float:
    r"""Number of equally frequent outcomes that would be as diverse.

    .. math:: \exp\bigl(-\textstyle\sum_k p_k \ln p_k\bigr)

    Args:
        outcomes: outcome of each episode.

    Raises:
        BMRLError: if there is no episode.

    Example:
        >>> effective_number(["lifted", "right", "lifted", "right"])
        2.0
    """
    counts = np.array(list(Counter(outcomes).values()), dtype=np.float64)
    if not counts.size:
        raise BMRLError("there is no outcome; valid: at least one")
    shares = counts / counts.sum()
    return float(np.exp(-(shares * np.log(shares)).sum()))


def matching_noise(actions: ArrayLike, size: float) -> float:
    r"""Standard deviation of action noise that causes a given mean deviation of the actions.

    It is the :math:`\sigma` for which the mean over actions of
    :math:`\lVert \operatorname{clip}(a + \sigma \varepsilon, -1, 1) - a \rVert` is ``size``, with
    one draw of :math:`\varepsilon \sim N(0, I)` per action.

    Args:
        actions: actions without noise, in [-1, 1], shape ``(N, action_dim)``.
        size: mean norm of the deviation.

    Raises:
        BMRLError: if no noise within the bounds causes such a deviation.

    Example:
        >>> sigma = matching_noise(np.zeros((10_000, 1)), 0.08)  # E|ε| is 0.80
        >>> round(sigma, 2)
        0.1
    """
    array = _finite(actions, "actions")
    noise = np.random.default_rng(0).standard_normal(array.shape)

    def reached(sigma: float) -> float:
        return float(np.linalg.norm(np.clip(array + sigma * noise, -1, 1) - array, axis=-1).mean())

    low, high = 0.0, 100.0
    if not 0 <= size <= reached(high):
        raise BMRLError(f"size is {size}; valid: between 0 and {reached(high):.3g}")
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if reached(middle) < size else (low, middle)
    return high


def _finite(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim < 2 or not array.size or not np.isfinite(array).all():
        raise BMRLError(f"{name} have shape {array.shape}; valid: at least one row, all finite")
    return array
