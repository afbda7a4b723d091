"""The paper's figures 3 to 5 as PNG images, drawn without pyplot's global state.

Equal data gives equal bytes: sizes, colours, seeds and metadata are fixed.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.embedding import is_one_point
from torchrl_bmrl.extras import needs
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports.tables import task_name

with needs("reports"):
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Patch

# Okabe & Ito's palette, which stays distinct under the common colour-vision deficiencies.
_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
TASK_COLORS: Mapping[str, str] = dict(zip(TASKS, _OKABE_ITO, strict=True))
"""One colour per task, the same in every figure."""

Curve = Sequence[tuple[int, int, NDArray[np.float64]]]
"""Evaluations during training: epoch, update, and the returns of that epoch's episodes ``(E,)``."""

_DPI = 120
_GREY = "#555555"


def stage1_curves(
    curves: Mapping[str, Curve], *, expert_means: Mapping[str, float] | None = None
) -> bytes:
    """Mean and spread of the rollout return after each epoch, one panel per task (figure 3).

    Args:
        curves: Evaluations by task.
        expert_means: Mean return of the expert by task, drawn as a dashed line.

    Returns:
        PNG image.

    Raises:
        BMRLError: if there is no curve of one of the six tasks.

    Example:
        >>> returns = np.array([90.0, 110.0])
        >>> stage1_curves({"reach": [(1, 500, returns), (2, 1000, returns + 20)]})[1:4]
        b'PNG'
    """
    tasks = [task for task in TASKS if task in curves]
    if not tasks:
        raise BMRLError(f"no curve to draw; valid tasks: {', '.join(TASKS)}")
    columns = min(3, len(tasks))
    lines = -(-len(tasks) // columns)
    figure = Figure(figsize=(max(3.2 * columns, 4.8), 2.5 * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).flat
    for task, axes in zip(tasks, panels, strict=False):
        color = TASK_COLORS[task]
        epochs = np.array([epoch for epoch, _, _ in curves[task]])
        mean = np.array([returns.mean() for _, _, returns in curves[task]])
        std = np.array([returns.std() for _, _, returns in curves[task]])
        axes.fill_between(epochs, mean - std, mean + std, color=color, alpha=0.25, linewidth=0)
        axes.plot(epochs, mean, color=color, marker="o", markersize=3)
        if expert_means and task in expert_means:
            axes.axhline(expert_means[task], color=_GREY, linestyle="--", linewidth=1)
        axes.set_title(task_name(task), fontsize=10)
        axes.set_ylim(bottom=min(0.0, mean.min()))
        axes.xaxis.get_major_locator().set_params(integer=True)
        _tidy(axes)
    for axes in panels:  # those that no task took
        axes.set_axis_off()
    legend: list[Any] = [
        Line2D([], [], color=_GREY, marker="o", markersize=3, label="mean over episodes"),
        Patch(color=_GREY, alpha=0.25, linewidth=0, label="± 1 standard deviation"),
    ]
    if expert_means:
        legend.append(Line2D([], [], color=_GREY, linestyle="--", label="expert's mean"))
    figure.legend(handles=legend, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    figure.supxlabel(_epoch_label(curves), fontsize=10)
    figure.supylabel("Return (sum of rewards)", fontsize=10)
    return _png(figure)


def embedding_scatter(task_latent: NDArray[Any], task: NDArray[np.integer[Any]]) -> bytes:
    """The embeddings of transitions, coloured by task (figure 4a).

    Args:
        task_latent: Embeddings m, shape ``(N, d)``; with d > 2 their first two principal components
            are drawn, and the title says so.
        task: Class index of each transition, shape ``(N,)``.

    Returns:
        PNG image.

    Raises:
        BMRLError: if a class index is none of the tasks'.

    Example:
        >>> embedding_scatter(np.eye(3, 2), np.array([0, 1, 5]))[1:4]
        b'PNG'
    """
    points, note = _plane(task_latent)
    figure, axes = _square()
    _scatter_by_task(axes, points, task)
    axes.set_title(f"Task embedding m of transitions{note}", fontsize=11)
    _name_axes(axes, note)
    return _png(figure)


def embedding_tsne(
    task_latent: NDArray[Any], task: NDArray[np.integer[Any]], *, seed: int = 0
) -> bytes:
    """A t-SNE map of the embeddings, coloured by task (figure 4b).

    Args:
        task_latent: Embeddings m, shape ``(N, d)``, N of at least 4; at most 3000 of them, drawn at
            random, are mapped.
        task: Class index of each transition, shape ``(N,)``.
        seed: Seed of the draw and of t-SNE.

    Returns:
        PNG image.

    Raises:
        BMRLError: for less than 4 transitions, or a class index that is none of the tasks'.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(20, 2))
        >>> embedding_tsne(points, np.arange(20) % 6)[1:4]
        b'PNG'
    """
    chosen, points = _tsne(task_latent, seed)
    figure, axes = _square()
    _scatter_by_task(axes, points, task[chosen])
    axes.set_title(f"t-SNE of the task embedding m ({len(chosen):,} transitions)", fontsize=11)
    axes.set_xlabel("t-SNE 1 (no unit)")
    axes.set_ylabel("t-SNE 2 (no unit)")
    return _png(figure)


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
        BMRLError: for less than 4 transitions.

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
    # Groups have no names: they take the phases' colors so that most points keep theirs.
    named = np.argsort(linear_sum_assignment(-shared)[1])
    chosen, points = _tsne(task_latent, seed)
    figure = Figure(figsize=(9.4, 4.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    colors = np.array(_OKABE_ITO)
    for axes, label, title in (
        (left, phase[chosen], "recorded phase of the expert"),
        (right, named[stage[chosen]], "group found without labels"),
    ):
        _tidy(axes)
        axes.scatter(*points.T, c=colors[label % len(colors)], s=12, alpha=0.8, linewidths=0)
        axes.set_title(title, fontsize=11)
        axes.set_xlabel("t-SNE 1 (no unit)")
    left.set_ylabel("t-SNE 2 (no unit)")
    _legend_below(
        left, [_dot(name, "o", colors[i % len(colors)]) for i, name in enumerate(phase_names)]
    )
    return _png(figure)


def reach_trajectories(
    task_latent: NDArray[Any],
    episode: NDArray[np.integer[Any]],
    distance: NDArray[np.floating[Any]],
    *,
    success_point: NDArray[Any] | None = None,
    max_episodes: int = 12,
) -> bytes:
    """Episodes as lines through the embedding, coloured by distance to the goal (figure 5).

    Args:
        task_latent: Embeddings m of one task's transitions, shape ``(N, d)``, those of an episode
            in the order of time; with d > 2 their first two principal components are drawn.
        episode: Episode of each transition, shape ``(N,)``.
        distance: End effector to goal, shape ``(N,)``, [m].
        success_point: Where the task succeeds in the embedding, shape ``(d,)``: the centre of
            circles, each as wide as the embeddings at its distance to the goal are away from it.
        max_episodes: The first so many episodes are drawn; more are hard to tell apart.

    Returns:
        PNG image.

    Raises:
        BMRLError: without transitions.

    Example:
        >>> line = np.linspace(0.0, 1.0, 8)
        >>> points = np.stack([line, line**2], axis=1)
        >>> reach_trajectories(points, np.zeros(8, dtype=int), 0.3 * (1 - line))[1:4]
        b'PNG'
    """
    drawn = np.unique(episode)[:max_episodes]
    if drawn.size == 0:
        raise BMRLError("no trajectory to draw: there is no transition")
    # The point goes through the same projection as the transitions.
    center = np.empty((0, np.shape(task_latent)[1])) if success_point is None else success_point
    points, note = _plane(np.concatenate([task_latent, np.atleast_2d(center)]))
    points, center = points[: len(task_latent)], points[len(task_latent) :]
    figure, axes = _square()
    farthest = float(distance[np.isin(episode, drawn)].max())
    for number in drawn:
        path = points[episode == number]
        axes.plot(*path.T, color=_GREY, linewidth=0.6, alpha=0.6, zorder=1)
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
    _legend_below(
        axes,
        [
            _dot("start of an episode", "o", "white", edge="black"),
            _dot("end of an episode", "*", "#D55E00", edge="black", size=11),
        ],
    )
    axes.set_title(f"{len(drawn)} reach episodes in the task embedding{note}", fontsize=11)
    _name_axes(axes, note)
    return _png(figure)


def success_curves(curves: Mapping[str, Sequence[NDArray[Any]]], *, title: str) -> bytes:
    """Success over the environment's steps: each seed thin, the mean over seeds thick.

    Args:
        curves: by name, one array ``(E, 2)`` for each seed: steps of the environment when it was
            evaluated, and the success rate then.
        title: of the figure.

    Returns:
        PNG image.

    Raises:
        BMRLError: if there is no curve.

    Example:
        >>> curve = np.array([[0, 0.0], [1000, 0.5], [2000, 1.0]])
        >>> success_curves({"latent": [curve, curve / 2], "raw": [0 * curve]}, title="T")[1:4]
        b'PNG'
    """
    if not curves or not all(curves.values()):
        raise BMRLError("no curve to draw; valid: at least one for each name")
    figure = Figure(figsize=(6.2, 3.8), layout="constrained")
    axes = figure.subplots()
    _tidy(axes)
    for (name, seeds), color in zip(curves.items(), _OKABE_ITO, strict=False):
        for curve in seeds:
            axes.plot(*np.asarray(curve).T, color=color, linewidth=0.8, alpha=0.5)
        # Seeds are evaluated at about the same steps; the mean is taken at all of them.
        steps = np.unique(np.concatenate([np.asarray(curve)[:, 0] for curve in seeds]))
        mean = np.mean([np.interp(steps, *np.asarray(curve).T) for curve in seeds], axis=0)
        axes.plot(steps, mean, color=color, linewidth=2.2, label=f"{name}, mean of {len(seeds)}")
    axes.axhline(0.5, color=_GREY, linestyle="--", linewidth=0.8)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("Steps of the environment")
    axes.set_ylabel("Success rate")
    axes.set_title(title, fontsize=11)
    figure.legend(loc="outside lower center", ncols=len(curves), frameon=False, fontsize=9)
    return _png(figure)


def _level_sets(
    points: NDArray[np.float64], center: NDArray[np.float64], distance: NDArray[np.floating[Any]]
) -> list[tuple[float, float]]:
    """Distances to the goal [m], and how far from the center the transitions there lie."""
    away = np.linalg.norm(points - center, axis=1)
    edges = np.linspace(0.0, float(distance.max()), 5)
    bands = [(distance >= low) & (distance <= high) for low, high in pairwise(edges)]
    return [
        (float(np.median(distance[band])), float(np.median(away[band])))
        for band in bands
        if band.sum() >= 3
    ]


def _tsne(
    task_latent: NDArray[Any], seed: int
) -> tuple[NDArray[np.integer[Any]], NDArray[np.float64]]:
    """Which embeddings were drawn at random, at most 3000, and their map ``(N, 2)``."""
    with needs("reports"):
        from sklearn.manifold import TSNE
        from threadpoolctl import threadpool_limits

    count = len(task_latent)
    if count < 4:
        raise BMRLError(f"t-SNE needs at least 4 embeddings, got {count}")
    chosen = np.arange(count)
    if count > 3000:
        chosen = np.sort(np.random.default_rng(seed).choice(count, 3000, replace=False))
    points = np.asarray(task_latent, dtype=np.float64)[chosen]
    if is_one_point(points):  # which has no neighbours to keep
        return chosen, np.zeros((len(chosen), 2))
    tsne = TSNE(
        n_components=2,
        perplexity=min(30.0, (len(chosen) - 1) / 3),
        init="pca" if np.shape(task_latent)[1] >= 2 else "random",  # PCA keeps the overall layout
        random_state=seed,
    )
    # Several threads add up in an order that changes from run to run, and so would the map.
    with threadpool_limits(limits=1):
        return chosen, tsne.fit_transform(points)


def _plane(task_latent: NDArray[Any]) -> tuple[NDArray[np.float64], str]:
    """Embeddings as points in the plane ``(N, 2)``, and what to add to the title."""
    points = np.asarray(task_latent, dtype=np.float64)
    dim = points.shape[1]
    if dim == 2:
        return points, ""
    if dim == 1:
        return np.pad(points, ((0, 0), (0, 1))), "\n1-D, drawn on a line"
    if is_one_point(points):  # it has no principal components
        return np.zeros((len(points), 2)), f"\n{dim}-D, all of it one point"
    with needs("reports"):
        from sklearn.decomposition import PCA

    plane = PCA(n_components=2, svd_solver="full").fit(points)
    share = plane.explained_variance_ratio_.sum()
    return plane.transform(
        points
    ), f"\n{dim}-D, its first two principal components ({share:.0%} of the variance)"


def _scatter_by_task(
    axes: Axes, points: NDArray[np.float64], task: NDArray[np.integer[Any]]
) -> None:
    present = np.unique(task)
    if present.size and not 0 <= present[0] <= present[-1] < len(TASKS):
        raise BMRLError(f"class indices must lie in [0, {len(TASKS)}), got {present.tolist()}")
    # In one shuffled cloud no task hides the others where clusters overlap.
    order = np.random.default_rng(0).permutation(len(points))
    colors = np.array(list(TASK_COLORS.values()))[task]
    size = float(np.clip(2e4 / max(len(points), 1), 4.0, 25.0))
    axes.scatter(
        points[order, 0], points[order, 1], c=colors[order], s=size, alpha=0.7, linewidths=0
    )
    names = [TASKS[index] for index in present]
    _legend_below(axes, [_dot(task_name(name), "o", TASK_COLORS[name]) for name in names])


def _dot(label: str, marker: str, color: str, *, edge: str = "none", size: float = 7) -> Line2D:
    return Line2D(
        [],
        [],
        label=label,
        marker=marker,
        color=color,
        linestyle="none",
        markersize=size,
        markeredgecolor=edge,
    )


def _legend_below(axes: Axes, handles: list[Any]) -> None:
    axes.figure.legend(
        handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9
    )


def _square() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(6.2, 5.6), layout="constrained")
    axes = figure.subplots()
    _tidy(axes)
    return figure, axes


def _name_axes(axes: Axes, note: str) -> None:
    # Distances in the embedding are what the paper reads off; one unit is as long both ways.
    axes.set_aspect("equal", adjustable="datalim")
    name = "principal component" if "principal" in note else "m"
    axes.set_xlabel(f"{name} 1 (no unit)")
    axes.set_ylabel(f"{name} 2 (no unit)")


def _epoch_label(curves: Mapping[str, Curve]) -> str:
    lengths = {update / epoch for curve in curves.values() for epoch, update, _ in curve if epoch}
    return f"Epoch ({lengths.pop():,.0f} updates each)" if len(lengths) == 1 else "Epoch"


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)


def _png(figure: Figure) -> bytes:
    data = io.BytesIO()
    # Without this the file names matplotlib's version, and equal pictures differ.
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    return data.getvalue()


def behaviour_trajectories(
    positions: Mapping[str, NDArray[Any]], along: Mapping[str, NDArray[Any]]
) -> bytes:
    """End-effector trajectories of several methods, from above and from the side.

    Args:
        positions: By the method's name, relative to each episode's start, shape ``(N, T, 3)`` [m].
        along: How far along its path m was, 0 to 1, shape ``(N, 1)`` or ``(N, T)``; where it is
            not a number, the trajectory is grey.

    Returns:
        PNG image.

    Example:
        >>> line = np.linspace(0.0, 0.1, 12).reshape(2, 2, 3)
        >>> behaviour_trajectories({"straight": line}, {"straight": np.array([[0.5], [1.0]])})[1:4]
        b'PNG'
    """
    if not positions:
        raise BMRLError("no trajectory to draw: there is no method")
    count = len(positions)
    figure = Figure(figsize=(max(2.4 * count, 5.0), 5.2), layout="constrained")
    panels = figure.subplots(2, count, squeeze=False, sharex="row", sharey="row")
    norm = Normalize(0, 1)
    for column, (name, paths) in enumerate(positions.items()):
        x, y, z = np.moveaxis(np.asarray(paths, dtype=np.float64), -1, 0)
        color = np.broadcast_to(along[name][:, : x.shape[1]], x.shape)
        known = np.isfinite(color)
        # From above with the robot at the bottom: its left, +y, is to the left.
        for axes, a, b in ((panels[0, column], y, x), (panels[1, column], y, z)):
            axes.scatter(a[~known], b[~known], color=_GREY, s=2, alpha=0.4, linewidths=0)
            axes.scatter(a[known], b[known], c=color[known], norm=norm, s=2, linewidths=0)
            axes.plot(0, 0, "+", color="black", markersize=8)
            axes.set_aspect("equal")
            _tidy(axes)
        panels[0, column].set_title(name, fontsize=10)
        panels[1, column].set_xlabel("to the left [m]", fontsize=9)
    for axes in panels[:, 0]:
        axes.invert_xaxis()  # shared along the row
    panels[0, 0].set_ylabel("from above: away [m]", fontsize=9)
    panels[1, 0].set_ylabel("from behind: up [m]", fontsize=9)
    figure.colorbar(
        ScalarMappable(norm), ax=panels, label="Position along the interpolation", shrink=0.7
    )
    return _png(figure)


def embedding_paths(
    task_latent: NDArray[Any],
    task: NDArray[np.integer[Any]],
    paths: Mapping[str, Sequence[NDArray[Any]]],
    points: NDArray[Any],
) -> bytes:
    """The embedding with paths through it: straight ones dashed, others solid.

    Args:
        task_latent: Embeddings m of transitions, shape ``(N, d)``; with d > 2 the first two
            principal components of everything shown are drawn.
        task: Class index of each transition, shape ``(N,)``.
        paths: By kind, ``"straight"`` or another, shape ``(P, d)`` each.
        points: Single points of m, shape ``(K, d)``.

    Returns:
        PNG image.

    Example:
        >>> paths = {"straight": [np.eye(2, 2)]}
        >>> embedding_paths(np.eye(3, 2), np.array([0, 1, 5]), paths, np.zeros((1, 2)))[1:4]
        b'PNG'
    """
    flat = [(kind, path) for kind, some in paths.items() for path in some]
    parts = [task_latent, points, *(path for _, path in flat)]
    plane, note = _plane(np.concatenate(parts))
    drawn = np.split(plane, np.cumsum([len(part) for part in parts])[:-1])
    figure, axes = _square()
    _scatter_by_task(axes, drawn[0], task)
    axes.plot(*drawn[1].T, "x", color="black", markersize=4, label="random points")
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
    _name_axes(axes, note)
    return _png(figure)
