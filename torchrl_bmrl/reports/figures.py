"""Figures of returns, success rates and trajectories as PNG images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.reports.drawing import GREY, png, task_colors, tidy
from torchrl_bmrl.reports.tables import task_titles

with needs("reports"):
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

Curve = Sequence[tuple[int, int, NDArray[np.float64]]]
"""Evaluations during training: epoch, update, and the returns of that epoch's episodes ``(E,)``."""


def stage1_curves(
    curves: Mapping[str, Curve],
    *,
    titles: Mapping[str, str] | None = None,
    expert_means: Mapping[str, float] | None = None,
) -> bytes:
    """Mean and spread of the rollout return after each epoch, one panel per task (figure 3).

    Args:
        curves: Evaluations by task.
        titles: Titles by task, as in :func:`~torchrl_bmrl.reports.tables.task_titles`; a task's
            position decides its colour.
        expert_means: Mean return of the expert by task, drawn as a dashed line.

    Returns:
        PNG image.

    Raises:
        BMRLError: if there is no curve.

    Example:
        >>> returns = np.array([90.0, 110.0])
        >>> stage1_curves({"reach": [(1, 500, returns), (2, 1000, returns + 20)]})[1:4]
        b'PNG'
    """
    if not curves:
        raise BMRLError("no curve to draw; valid: at least one task's")
    titles = task_titles(curves, titles)
    styles = zip(titles.items(), task_colors(len(titles)), strict=True)
    drawn = [(task, title, color) for (task, title), color in styles if task in curves]
    columns = min(3, len(drawn))
    lines = -(-len(drawn) // columns)
    figure = Figure(figsize=(max(3.2 * columns, 4.8), 2.5 * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).flat
    for (task, title, color), axes in zip(drawn, panels, strict=False):
        epochs = np.array([epoch for epoch, _, _ in curves[task]])
        mean = np.array([returns.mean() for _, _, returns in curves[task]])
        std = np.array([returns.std() for _, _, returns in curves[task]])
        axes.fill_between(epochs, mean - std, mean + std, color=color, alpha=0.25, linewidth=0)
        axes.plot(epochs, mean, color=color, marker="o", markersize=3)
        if expert_means and task in expert_means:
            axes.axhline(expert_means[task], color=GREY, linestyle="--", linewidth=1)
        axes.set_title(title, fontsize=10)
        # The axes include zero; all other ends have Matplotlib's margin.
        axes.axhline(0.0, alpha=0.0).sticky_edges.y.append(0.0)
        axes.xaxis.get_major_locator().set_params(integer=True)
        tidy(axes)
    for axes in panels:  # the remaining panels are empty
        axes.set_axis_off()
    legend: list[Any] = [
        Line2D([], [], color=GREY, marker="o", markersize=3, label="mean over episodes"),
        Patch(color=GREY, alpha=0.25, linewidth=0, label="± 1 standard deviation"),
    ]
    if expert_means:
        legend.append(Line2D([], [], color=GREY, linestyle="--", label="expert's mean"))
    figure.legend(handles=legend, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    lengths = {update / epoch for curve in curves.values() for epoch, update, _ in curve if epoch}
    label = f"Epoch ({lengths.pop():,.0f} updates each)" if len(lengths) == 1 else "Epoch"
    figure.supxlabel(label, fontsize=10)
    figure.supylabel("Return (sum of rewards)", fontsize=10)
    return png(figure)


def success_curves(curves: Mapping[str, Sequence[NDArray[Any]]], *, title: str) -> bytes:
    """Success rate against environment steps: thin lines for seeds, a thick line for their mean.

    Args:
        curves: By name, one array ``(E, 2)`` per seed: environment steps and success rate of each
            evaluation.
        title: Title of the figure.

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
    tidy(axes)
    for (name, seeds), color in zip(curves.items(), task_colors(len(curves)), strict=True):
        for curve in seeds:
            axes.plot(*np.asarray(curve).T, color=color, linewidth=0.8, alpha=0.5)
        # The seeds' evaluations are at slightly different steps; the mean is taken at all of them.
        steps = np.unique(np.concatenate([np.asarray(curve)[:, 0] for curve in seeds]))
        mean = np.mean([np.interp(steps, *np.asarray(curve).T) for curve in seeds], axis=0)
        axes.plot(steps, mean, color=color, linewidth=2.2, label=f"{name}, mean of {len(seeds)}")
    axes.axhline(0.5, color=GREY, linestyle="--", linewidth=0.8)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("Steps of the environment")
    axes.set_ylabel("Success rate")
    axes.set_title(title, fontsize=11)
    figure.legend(loc="outside lower center", ncols=len(curves), frameon=False, fontsize=9)
    return png(figure)


def behaviour_trajectories(
    positions: Mapping[str, NDArray[Any]], along: Mapping[str, NDArray[Any]]
) -> bytes:
    """End-effector trajectories of several methods, from above and from behind.

    Args:
        positions: By the method's name, positions relative to each episode's start, shape
            ``(N, T, 3)`` [m].
        along: Position of m along its path, 0 to 1, shape ``(N, 1)`` or ``(N, T)``; trajectories
            are grey where it is NaN.

    Returns:
        PNG image.

    Raises:
        BMRLError: if there is no method.

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
            axes.scatter(a[~known], b[~known], color=GREY, s=2, alpha=0.4, linewidths=0)
            axes.scatter(a[known], b[known], c=color[known], norm=norm, s=2, linewidths=0)
            axes.plot(0, 0, "+", color="black", markersize=8)
            axes.set_aspect("equal")
            tidy(axes)
        panels[0, column].set_title(name, fontsize=10)
        panels[1, column].set_xlabel("to the left [m]", fontsize=9)
    for axes in panels[:, 0]:
        axes.invert_xaxis()  # shared along the row
    panels[0, 0].set_ylabel("from above: away [m]", fontsize=9)
    panels[1, 0].set_ylabel("from behind: up [m]", fontsize=9)
    figure.colorbar(
        ScalarMappable(norm), ax=panels, label="Position along the interpolation", shrink=0.7
    )
    return png(figure)
