"""Figures of the task embedding m (the paper's figures 4 and 5) as PNG images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.reports.drawing import (
    GREY,
    dot,
    legend_below,
    name_axes,
    plane,
    png,
    scatter_by_task,
    square,
    task_colors,
    tidy,
    tsne,
)

with needs("reports"):
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

_MAX_EPISODES = 12  # more trajectories in one figure are hard to tell apart


def embedding_scatter(
    task_latent: NDArray[Any], task: NDArray[np.integer[Any]], titles: Sequence[str]
) -> bytes:
    """Embeddings of transitions, coloured by task (figure 4a).

    Args:
        task_latent: Embeddings m, shape ``(N, d)``; for d > 2 their first two principal components
            are drawn, and the title says so.
        task: Class index of each transition, shape ``(N,)``.
        titles: Titles of the tasks by class index.

    Returns:
        PNG image.

    Raises:
        BMRLError: if a class index has no title.

    Example:
        >>> embedding_scatter(np.eye(3, 2), np.array([0, 1, 1]), ["Reach", "Lift"])[1:4]
        b'PNG'
    """
    points, note = plane(task_latent)
    figure, axes = square()
    scatter_by_task(axes, points, task, titles)
    axes.set_title(f"Task embedding m of transitions{note}", fontsize=11)
    name_axes(axes, note)
    return png(figure)


def embedding_tsne(
    task_latent: NDArray[Any],
    task: NDArray[np.integer[Any]],
    titles: Sequence[str],
    *,
    seed: int = 0,
) -> bytes:
    """A t-SNE map of the embeddings, coloured by task (figure 4b).

    Args:
        task_latent: Embeddings m, shape ``(N, d)``, N of at least 4; at most 3000 of them, drawn at
            random, are mapped.
        task: Class index of each transition, shape ``(N,)``.
        titles: Titles of the tasks by class index.
        seed: Seed of the draw and of t-SNE.

    Returns:
        PNG image.

    Raises:
        BMRLError: for fewer than 4 transitions, or a class index that has no title.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(20, 2))
        >>> embedding_tsne(points, np.arange(20) % 2, ["Reach", "Lift"])[1:4]
        b'PNG'
    """
    chosen, points = tsne(task_latent, seed)
    figure, axes = square()
    scatter_by_task(axes, points, task[chosen], titles)
    axes.set_title(f"t-SNE of the task embedding m ({len(chosen):,} transitions)", fontsize=11)
    axes.set_xlabel("t-SNE 1 (no unit)")
    axes.set_ylabel("t-SNE 2 (no unit)")
    return png(figure)


def embedding_stages(
    task_latent: NDArray[Any],
    phase: NDArray[np.integer[Any]],
    stage: NDArray[np.integer[Any]],
    phase_names: Sequence[str],
    *,
    seed: int = 0,
) -> bytes:
    """A t-SNE map of one task's embeddings: recorded phases beside the groups that were found.

    Args:
        task_latent: Embeddings m of the task's transitions, shape ``(N, d)``, N of at least 4.
        phase: The expert's phase, shape ``(N,)``, an index into ``phase_names``.
        stage: Group of each transition, shape ``(N,)``.
        phase_names: Names of the phases.
        seed: Seed of t-SNE.

    Returns:
        PNG image.

    Raises:
        BMRLError: for fewer than 4 transitions.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(20, 2))
        >>> embedding_stages(points, np.arange(20) % 2, np.arange(20) % 2, ["a", "b"])[1:4]
        b'PNG'
    """
    with needs("reports"):
        from scipy.optimize import linear_sum_assignment

    count = len(phase_names)
    shared = np.array(
        [[((phase == i) & (stage == j)).sum() for j in range(count)] for i in range(count)]
    )
    # Groups have no names. Each takes a phase's colour, so that most points have the same colour
    # on both sides.
    named = np.argsort(linear_sum_assignment(-shared)[1])
    chosen, points = tsne(task_latent, seed)
    figure = Figure(figsize=(9.4, 4.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    colors = np.array(task_colors(count))
    for axes, label, title in (
        (left, phase[chosen], "recorded phase of the expert"),
        (right, named[stage[chosen]], "group found without labels"),
    ):
        tidy(axes)
        axes.scatter(points[:, 0], points[:, 1], c=colors[label], s=12, alpha=0.8, linewidths=0)
        axes.set_title(title, fontsize=11)
        axes.set_xlabel("t-SNE 1 (no unit)")
    left.set_ylabel("t-SNE 2 (no unit)")
    legend_below(
        left, [dot(name, "o", color) for name, color in zip(phase_names, colors, strict=True)]
    )
    return png(figure)


def embedding_trajectories(
    task_latent: NDArray[Any],
    episode: NDArray[np.integer[Any]],
    distance: NDArray[np.floating[Any]],
    *,
    title: str,
    success_point: NDArray[Any] | None = None,
) -> bytes:
    """Episodes as lines through the embedding, coloured by distance to the goal (figure 5).

    Args:
        task_latent: Embeddings m of one task's transitions, shape ``(N, d)``, those of an episode
            in the order of time; for d > 2 their first two principal components are drawn.
        episode: Episode of each transition, shape ``(N,)``; the first 12 are drawn.
        distance: Distance to the goal, shape ``(N,)``, [m].
        title: Title of the task.
        success_point: Point of the embedding where the task succeeds, shape ``(d,)``. Circles
            around it have the median radius of the embeddings at their distance to the goal.

    Returns:
        PNG image.

    Raises:
        BMRLError: if there is no transition.

    Example:
        >>> line = np.linspace(0.0, 1.0, 8)
        >>> points = np.stack([line, line**2], axis=1)
        >>> zeros = np.zeros(8, dtype=int)
        >>> embedding_trajectories(points, zeros, 0.3 * (1 - line), title="Reach")[1:4]
        b'PNG'
    """
    drawn = np.unique(episode)[:_MAX_EPISODES]
    if drawn.size == 0:
        raise BMRLError("no trajectory to draw: there is no transition")
    # The success point goes through the same projection as the transitions.
    center = np.empty((0, np.shape(task_latent)[1])) if success_point is None else success_point
    points, note = plane(np.concatenate([task_latent, np.atleast_2d(center)]))
    points, center = points[: len(task_latent)], points[len(task_latent) :]
    figure, axes = square()
    farthest = float(distance[np.isin(episode, drawn)].max())
    for number in drawn:
        path = points[episode == number]
        axes.plot(*path.T, color=GREY, linewidth=0.6, alpha=0.6, zorder=1)
        dots = axes.scatter(
            path[:, 0],
            path[:, 1],
            c=distance[episode == number],
            cmap="viridis",
            vmin=0.0,
            vmax=farthest,
            s=10,
            linewidths=0,
            zorder=2,
        )
        axes.plot(*path[0], "o", color="white", markeredgecolor="black", markersize=6, zorder=3)
        axes.plot(*path[-1], "*", color="#D55E00", markeredgecolor="black", markersize=12, zorder=4)
    bar = figure.colorbar(dots, ax=axes, label="Distance to the goal [m]", shrink=0.85)
    for level, radius in _level_sets(points, center, distance) if len(center) else ():
        color = dots.to_rgba(np.array([level]))[0]
        axes.add_patch(Circle(center[0], radius, fill=False, color=color, linewidth=1.5, zorder=2))
        bar.ax.axhline(level, color="white", linewidth=1.0)
    legend_below(
        axes,
        [
            dot("start of an episode", "o", "white", edge="black"),
            dot("end of an episode", "*", "#D55E00", edge="black", size=11),
        ],
    )
    axes.set_title(f"{title}: {len(drawn)} episodes in the task embedding{note}", fontsize=11)
    name_axes(axes, note)
    return png(figure)


def _level_sets(
    points: NDArray[np.float64], center: NDArray[np.float64], distance: NDArray[np.floating[Any]]
) -> list[tuple[float, float]]:
    """Returns distances to the goal [m], and how far from the center the transitions there lie."""
    away = np.linalg.norm(points - center, axis=1)
    edges = np.linspace(0.0, float(distance.max()), 5)
    bands = [(distance >= low) & (distance <= high) for low, high in pairwise(edges)]
    return [
        (float(np.median(distance[band])), float(np.median(away[band])))
        for band in bands
        if band.sum() >= 3
    ]


def embedding_paths(
    task_latent: NDArray[Any],
    task: NDArray[np.integer[Any]],
    titles: Sequence[str],
    paths: Mapping[str, Sequence[NDArray[Any]]],
    points: NDArray[Any],
) -> bytes:
    """The embedding with paths through it: straight ones dashed, others solid.

    Args:
        task_latent: Embeddings m of transitions, shape ``(N, d)``; for d > 2 the first two
            principal components of everything shown are drawn.
        task: Class index of each transition, shape ``(N,)``.
        titles: Titles of the tasks by class index.
        paths: By kind, ``"straight"`` or another, shape ``(P, d)`` each.
        points: Single points of m, shape ``(K, d)``.

    Returns:
        PNG image.

    Raises:
        BMRLError: if a class index has no title.

    Example:
        >>> paths = {"straight": [np.eye(2, 2)]}
        >>> names = ["Reach", "Lift"]
        >>> embedding_paths(np.eye(3, 2), np.array([0, 1, 1]), names, paths, np.zeros((1, 2)))[1:4]
        b'PNG'
    """
    flat = [(kind, path) for kind, some in paths.items() for path in some]
    parts = [task_latent, points, *(path for _, path in flat)]
    projected, note = plane(np.concatenate(parts))
    drawn = np.split(projected, np.cumsum([len(part) for part in parts])[:-1])
    figure, axes = square()
    scatter_by_task(axes, drawn[0], task, titles)
    axes.plot(*drawn[1].T, "x", color="black", markersize=4)
    for (kind, _), path in zip(flat, drawn[2:], strict=True):
        style = "--" if kind == "straight" else "-"
        axes.plot(*path.T, style, color="black", linewidth=1.2)
        axes.plot(*path[-1], "s", color="white", markeredgecolor="black", markersize=6, zorder=4)
    if flat:
        axes.plot(
            *drawn[2][0], "*", color="white", markeredgecolor="black", markersize=13, zorder=5
        )
    axes.set_title(
        "Paths through the embedding: straight (dashed), on the data (solid);\n"
        f"from the star to the squares, prototypes; crosses: random points{note}",
        fontsize=10,
    )
    name_axes(axes, note)
    return png(figure)
