"""Paths through the embedding: straight lines, and paths that stay close to data."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs


class PathError(BMRLError):
    """The points of a path have different dimensions, are not finite, or are too few.

    Example:
        >>> straight_path([0.0, 0.0], [1.0], 3)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.evaluation.paths.PathError: end has shape (1,); valid: (2,), finite
    """


def straight_path(start: ArrayLike, end: ArrayLike, num_points: int) -> NDArray[np.float64]:
    """Returns points at equal distances on the straight line between two points.

    Args:
        start: first point, shape ``(m,)``.
        end: last point, shape ``(m,)``.
        num_points: at least 2.

    Returns:
        shape ``(num_points, m)``.

    Raises:
        PathError: if the dimensions differ, or there are too few points.

    Example:
        >>> straight_path([0.0, 1.0], [1.0, 1.0], 3).tolist()
        [[0.0, 1.0], [0.5, 1.0], [1.0, 1.0]]
    """
    first, last, _ = _points(start, end, np.empty((0, np.size(start))), num_points)
    return np.linspace(first, last, num_points)


def data_path(
    data: ArrayLike, start: ArrayLike, end: ArrayLike, num_points: int, *, power: float = 3.0
) -> NDArray[np.float64]:
    r"""Returns points at equal distances on a path between two points that stays close to data.

    It is the shortest path :math:`x_0, \ldots, x_n` over data points when a hop costs the p-th
    power of its length,

    .. math:: \min \textstyle\sum_i \lVert x_{i+1} - x_i \rVert^p,

    so that many short hops through dense data cost less than one long hop across a gap. Unlike a
    graph of nearest neighbours, this always has a path and needs no number of neighbours.

    Reference: Bijral et al. 2012, *Semi-supervised learning with density based distances*,
    https://arxiv.org/abs/1202.3702.

    Args:
        data: points that the path may use, shape ``(N, m)``; memory grows with N² (8 MB for a
            thousand).
        start: first point, shape ``(m,)``.
        end: last point, shape ``(m,)``.
        num_points: at least 2.
        power: p, at least 1; at 1 the path is straight.

    Returns:
        shape ``(num_points, m)``.

    Raises:
        PathError: if the dimensions differ, there are too few points, or p is below 1.

    Example:
        >>> corner = [[0.0, 0.5], [0.0, 1.0], [0.5, 1.0]]
        >>> data_path(corner, [0.0, 0.0], [1.0, 1.0], 5).tolist()
        [[0.0, 0.0], [0.0, 0.5], [0.0, 1.0], [0.5, 1.0], [1.0, 1.0]]
    """
    if power < 1:
        raise PathError(f"power is {power}; valid: at least 1")
    first, last, between = _points(start, end, data, num_points)
    # Imported here because a process that only plays episodes does not need scipy.
    with needs("reports"):
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra
        from scipy.spatial.distance import cdist

    # A hop between equal points would cost 0, which csgraph takes for a missing edge.
    nodes = np.unique(np.vstack([first, last, between]), axis=0)
    source, target = (int(np.flatnonzero((nodes == x).all(1))[0]) for x in (first, last))
    length = cdist(nodes, nodes)
    # Relative to the longest hop, so that no power underflows. In a dense array csgraph would take
    # costs below 1e-8 for missing edges, too.
    cost = csr_array((length / (length.max() or 1.0)) ** power)
    _, before = dijkstra(cost, indices=source, return_predecessors=True)
    route = [target]
    while route[-1] != source:
        route.append(int(before[route[-1]]))
    corners = nodes[route[::-1]]
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=-1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.linspace(0.0, at[-1], num_points)
    return np.stack([np.interp(wanted, at, column) for column in corners.T], axis=-1)


def switched_path(
    first: ArrayLike, second: ArrayLike, *, at: int, steps: int
) -> NDArray[np.float64]:
    """Joins two sequences of embeddings by a straight line.

    Args:
        first: shape ``(T, m)``; its first ``at`` points are used.
        second: shape ``(T, m)``; its points from ``at + steps`` on are used.
        at: step of the line's first point, at least 1.
        steps: number of points on the line.

    Returns:
        shape ``(T, m)``.

    Raises:
        PathError: if the shapes differ, or the line does not end within the sequences.

    Example:
        >>> switched_path(np.zeros((5, 1)), np.ones((5, 1)), at=2, steps=1).ravel().tolist()
        [0.0, 0.0, 0.5, 1.0, 1.0]
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or at < 1 or steps < 0 or at + steps >= len(a):
        raise PathError(
            f"sequences of shapes {a.shape} and {b.shape}, a line over steps {at} to "
            f"{at + steps}; valid: equal shapes (T, m), 1 <= at, at + steps < T"
        )
    line = straight_path(a[at - 1], b[at + steps], steps + 2)[1:-1]
    return np.concatenate([a[:at], line, b[at + steps :]])


def _points(
    start: ArrayLike, end: ArrayLike, data: ArrayLike, num_points: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    if num_points < 2:
        raise PathError(f"num_points is {num_points}; valid: at least 2")
    first, last, between = (np.asarray(x, dtype=np.float64) for x in (start, end, data))
    m = first.size
    for name, array, shape in (
        ("start", first, (m,)),
        ("end", last, (m,)),
        ("data", between, (len(between) if between.ndim else 0, m)),
    ):
        if array.shape != shape or not np.isfinite(array).all():
            valid = f"({'N, ' if name == 'data' else ''}{m}{'' if name == 'data' else ','})"
            raise PathError(f"{name} has shape {array.shape}; valid: {valid}, finite")
    return first, last, between
