"""Shared parts of the figures: colours, projections to the plane, axes and legends.

Figures are drawn without pyplot's global state. Equal data gives equal bytes: sizes, colours, seeds
and metadata are fixed.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.embedding import is_one_point
from torchrl_bmrl.extras import needs

with needs("reports"):
    from matplotlib.axes import Axes
    from matplotlib.colors import to_hex, to_rgb
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

# Okabe & Ito's palette, which stays distinct under the common colour-vision deficiencies.
_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#555555"
"""Colour of what belongs to no task."""
FEWEST_MAPPED = 4
"""Number of embeddings that t-SNE needs at least."""


def task_colors(count: int) -> tuple[str, ...]:
    """Returns distinct colours, by position; the first ones do not depend on the count.

    The first six are Okabe and Ito's. Each further one is the colour of a grid that is farthest, in
    CIELAB, from those before it, from white and from :data:`GREY`.

    Args:
        count: Number of colours.

    Example:
        >>> task_colors(2)
        ('#0072B2', '#D55E00')
    """
    levels = np.linspace(0.0, 1.0, 9)
    grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
    grid = grid[_lab(grid)[:, 0] < 80.0]  # lighter ones are hard to see on white
    candidates = _lab(grid)
    colors = list(_OKABE_ITO[:count])
    taken = _lab(np.array([to_rgb(color) for color in (*_OKABE_ITO, "white", GREY)]))
    nearest = np.linalg.norm(candidates[:, None] - taken, axis=-1).min(1)
    while len(colors) < count:
        chosen = int(nearest.argmax())
        colors.append(to_hex(grid[chosen]).upper())
        nearest = np.minimum(nearest, np.linalg.norm(candidates - candidates[chosen], axis=-1))
    return tuple(colors)


def _lab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts sRGB in [0, 1] to CIELAB (D65), where distances are those that eyes see."""
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    x, y, z = np.moveaxis(np.cbrt(linear @ (to_xyz / to_xyz.sum(1, keepdims=True)).T), -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def tsne(
    task_latent: NDArray[Any], seed: int
) -> tuple[NDArray[np.integer[Any]], NDArray[np.float64]]:
    """Maps at most 3000 embeddings, drawn at random, by t-SNE.

    Args:
        task_latent: Embeddings m, shape ``(N, d)``, N of at least 4.
        seed: Seed of the draw and of t-SNE.

    Returns:
        Indices of the drawn embeddings, and their map ``(n, 2)``.

    Raises:
        BMRLError: for fewer than 4 embeddings.
    """
    with needs("reports"):
        from sklearn.manifold import TSNE
        from threadpoolctl import threadpool_limits

    count = len(task_latent)
    if count < FEWEST_MAPPED:
        raise BMRLError(f"t-SNE needs at least {FEWEST_MAPPED} embeddings, got {count}")
    chosen = np.arange(count)
    if count > 3000:
        chosen = np.sort(np.random.default_rng(seed).choice(count, 3000, replace=False))
    points = np.asarray(task_latent, dtype=np.float64)[chosen]
    if is_one_point(points):  # there are no neighbours to preserve
        return chosen, np.zeros((len(chosen), 2))
    model = TSNE(
        n_components=2,
        perplexity=min(30.0, (len(chosen) - 1) / 3),
        init="pca" if np.shape(task_latent)[1] >= 2 else "random",  # PCA keeps the overall layout
        random_state=seed,
    )
    # With several threads the order of sums, and so the map, would vary from run to run.
    with threadpool_limits(limits=1):
        return chosen, model.fit_transform(points)


def plane(
    task_latent: NDArray[Any], of: NDArray[Any] | None = None
) -> tuple[NDArray[np.float64], str]:
    """Projects embeddings to the plane.

    Args:
        task_latent: Embeddings m, shape ``(N, d)``; for d > 2 their first two principal components
            are taken.
        of: Embeddings ``(K, d)`` whose principal components are taken instead.

    Returns:
        Points ``(N, 2)``, and a note for the title; it is empty for d = 2.
    """
    points = np.asarray(task_latent, dtype=np.float64)
    fitted = points if of is None else np.asarray(of, dtype=np.float64)
    dim = points.shape[1]
    if dim == 2:
        return points, ""
    if dim == 1:
        return np.pad(points, ((0, 0), (0, 1))), "\n1-D, drawn on a line"
    if is_one_point(fitted):  # it has no principal components
        return np.zeros((len(points), 2)), f"\n{dim}-D, all of it one point"
    with needs("reports"):
        from sklearn.decomposition import PCA

    pca = PCA(n_components=2, svd_solver="full").fit(fitted)
    share = pca.explained_variance_ratio_.sum()
    note = f"\n{dim}-D, its first two principal components ({share:.0%} of the variance)"
    return pca.transform(points), note


def scatter_by_task(
    axes: Axes, points: NDArray[np.float64], task: NDArray[np.integer[Any]], titles: Sequence[str]
) -> None:
    """Draws points ``(N, 2)`` in the colours of their tasks, with a legend.

    Args:
        axes: Axes to draw on.
        points: Points in the plane.
        task: Class index of each point, shape ``(N,)``.
        titles: Titles of the tasks by class index.

    Raises:
        BMRLError: if a class index has no title.
    """
    present = np.unique(task)
    if present.size and not 0 <= present[0] <= present[-1] < len(titles):
        raise BMRLError(f"class indices must lie in [0, {len(titles)}), got {present.tolist()}")
    # A shuffled order keeps one task from hiding the others where clusters overlap.
    order = np.random.default_rng(0).permutation(len(points))
    colors = np.array(task_colors(len(titles)))
    size = float(np.clip(2e4 / max(len(points), 1), 4.0, 25.0))
    x, y = points[order].T
    axes.scatter(x, y, c=colors[task[order]], s=size, alpha=0.7, linewidths=0)
    legend_below(axes, [dot(titles[index], "o", colors[index]) for index in present])


def dot(label: str, marker: str, color: str, *, edge: str = "none", size: float = 7) -> Line2D:
    """Makes a legend entry: a single marker."""
    return Line2D(
        [],
        [],
        label=label,
        linestyle="none",
        marker=marker,
        color=color,
        markeredgecolor=edge,
        markersize=size,
    )


def legend_below(axes: Axes, handles: list[Any]) -> None:
    """Puts a legend below the figure."""
    axes.figure.legend(
        handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9
    )


def square() -> tuple[Figure, Axes]:
    """Makes a nearly square figure with one pair of axes."""
    figure = Figure(figsize=(6.2, 5.6), layout="constrained")
    axes = figure.subplots()
    tidy(axes)
    return figure, axes


def name_axes(axes: Axes, note: str) -> None:
    """Labels the axes of :func:`plane`, with equal scales in both directions."""
    axes.set_aspect("equal", adjustable="datalim")
    name = "principal component" if "principal" in note else "m"
    axes.set_xlabel(f"{name} 1 (no unit)")
    axes.set_ylabel(f"{name} 2 (no unit)")


def tidy(axes: Axes) -> None:
    """Removes the frame and draws a light grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)


def png(figure: Figure) -> bytes:
    """Renders a figure as a PNG image."""
    data = io.BytesIO()
    for text in figure.findobj(Text):
        # A name may have dollar signs; the labels of logarithmic axes are formulas.
        if "$" in text.get_text() and "\\mathdefault" not in text.get_text():
            text.set_parse_math(False)
    # Without this the file names matplotlib's version, and equal pictures differ.
    figure.savefig(data, format="png", dpi=120, metadata={"Software": None})
    return data.getvalue()
