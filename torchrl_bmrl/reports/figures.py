"""The paper's figures 3 to 5 as PNG images, drawn without pyplot's global state.

Equal data gives equal bytes: sizes, colours, seeds and metadata are fixed.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports.tables import task_name

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

    Example:
        >>> points = np.random.default_rng(0).normal(size=(20, 2))
        >>> embedding_tsne(points, np.arange(20) % 6)[1:4]
        b'PNG'
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    count = len(task_latent)
    if count < 4:
        raise BMRLError(f"t-SNE needs at least 4 embeddings, got {count}")
    chosen = np.arange(count)
    if count > 3000:
        chosen = np.sort(np.random.default_rng(seed).choice(count, 3000, replace=False))
    tsne = TSNE(
        n_components=2,
        perplexity=min(30.0, (len(chosen) - 1) / 3),
        init="pca" if np.shape(task_latent)[1] >= 2 else "random",  # PCA keeps the overall layout
        random_state=seed,
    )
    # Several threads add up in an order that changes from run to run, and so would the map.
    with threadpool_limits(limits=1):
        points = tsne.fit_transform(np.asarray(task_latent, dtype=np.float64)[chosen])
    figure, axes = _square()
    _scatter_by_task(axes, points, task[chosen])
    axes.set_title(f"t-SNE of the task embedding m ({len(chosen):,} transitions)", fontsize=11)
    axes.set_xlabel("t-SNE 1 (no unit)")
    axes.set_ylabel("t-SNE 2 (no unit)")
    return _png(figure)


def reach_trajectories(
    task_latent: NDArray[Any],
    episode: NDArray[np.integer[Any]],
    distance: NDArray[np.floating[Any]],
    *,
    max_episodes: int = 12,
) -> bytes:
    """Episodes as lines through the embedding, coloured by distance to the goal (figure 5).

    Args:
        task_latent: Embeddings m of one task's transitions, shape ``(N, d)``, those of an episode
            in the order of time; with d > 2 their first two principal components are drawn.
        episode: Episode of each transition, shape ``(N,)``.
        distance: End effector to goal, shape ``(N,)``, [m].
        max_episodes: The first so many episodes are drawn; more are hard to tell apart.

    Returns:
        PNG image.

    Example:
        >>> line = np.linspace(0.0, 1.0, 8)
        >>> points = np.stack([line, line**2], axis=1)
        >>> reach_trajectories(points, np.zeros(8, dtype=int), 0.3 * (1 - line))[1:4]
        b'PNG'
    """
    drawn = np.unique(episode)[:max_episodes]
    if drawn.size == 0:
        raise BMRLError("no trajectory to draw: there is no transition")
    points, note = _plane(task_latent)
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
    figure.colorbar(dots, ax=axes, label="Distance to the goal [m]", shrink=0.85)
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

    Example:
        >>> curve = np.array([[0, 0.0], [1000, 0.5], [2000, 1.0]])
        >>> success_curves({"latent": [curve, curve / 2], "raw": [0 * curve]}, title="T")[1:4]
        b'PNG'
    """
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


def _plane(task_latent: NDArray[Any]) -> tuple[NDArray[np.float64], str]:
    """Embeddings as points in the plane ``(N, 2)``, and what to add to the title."""
    points = np.asarray(task_latent, dtype=np.float64)
    dim = points.shape[1]
    if dim == 2:
        return points, ""
    if dim == 1:
        return np.pad(points, ((0, 0), (0, 1))), "\n1-D, drawn on a line"
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
