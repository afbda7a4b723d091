"""Figures repeat exactly, change with their data, and refuse what they cannot draw."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from report_data import NAMES, make_embeddings

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.reports import (
    behaviour_trajectories,
    embedding_paths,
    embedding_scatter,
    embedding_stages,
    embedding_trajectories,
    embedding_tsne,
    stage1_curves,
    task_colors,
)
from torchrl_bmrl.reports.drawing import _lab


def trajectories(*arguments: Any, **options: Any) -> bytes:
    return embedding_trajectories(*arguments, title="Reach", **options)


@pytest.mark.parametrize("count", [6, 14, 24])
def test_colors_are_far_apart_and_do_not_change_with_the_number_of_tasks(count: int) -> None:
    colors = task_colors(count)
    assert colors[:3] == task_colors(3)
    assert len(colors) == count
    lab = _lab(np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colors]))
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)[~np.eye(count, dtype=bool)]
    assert apart.min() > 25.0  # a just noticeable difference is about 2
    assert lab[:, 0].max() < 80.0  # dark enough on white


def test_figures_repeat_exactly_and_change_with_the_data() -> None:
    data = make_embeddings()
    moved = data.task_latent + data.step[:, None]
    curve = [(e, 10 * e, np.array([1.0 * e, 2.0 * e])) for e in (1, 2, 3)]
    draws = [
        lambda m: embedding_scatter(m, data.task, NAMES),
        lambda m: embedding_tsne(m, data.task, NAMES, seed=0),
        lambda m: trajectories(m, data.episode, data.distance),
        lambda m: trajectories(m, data.episode, data.distance, success_point=m[0]),
        lambda m: embedding_stages(m, data.phase, data.step // 3, ("a", "b", "c")),
        lambda m: stage1_curves({"lift": curve}, expert_means={"lift": float(m.sum())}),
        lambda m: embedding_paths(
            m, data.task, NAMES, {"straight": [m[:5]], "curve": [m[3:7]]}, m[:2]
        ),
        lambda m: behaviour_trajectories(
            {"line": np.tile(m, (1, 1, 2))[..., :3]}, {"line": m[:1, :1]}
        ),
    ]
    for draw in draws:
        image = draw(data.task_latent)
        assert image.startswith(b"\x89PNG")
        assert len(image) < 300_000
        assert draw(data.task_latent) == image
        assert draw(moved) != image


def test_colors_follow_task_and_distance() -> None:
    data = make_embeddings()
    swapped = (data.task + 1) % 6
    latent = data.task_latent
    assert embedding_scatter(latent, data.task, NAMES) != embedding_scatter(latent, swapped, NAMES)
    assert trajectories(latent, data.episode, data.distance) != trajectories(
        latent, data.episode, data.distance[::-1]
    )


@pytest.mark.parametrize("dim", [1, 3])
def test_embeddings_of_other_sizes_are_drawn(dim: int) -> None:
    data = make_embeddings(dim)
    for image in (
        embedding_scatter(data.task_latent, data.task, NAMES),
        embedding_tsne(data.task_latent[:40], data.task[:40], NAMES),
        trajectories(data.task_latent, data.episode, data.distance),
        trajectories(
            data.task_latent, data.episode, data.distance, success_point=data.task_latent[0]
        ),
        embedding_stages(data.task_latent[:40], data.phase[:40], data.phase[:40], ("a", "b", "c")),
        embedding_paths(
            data.task_latent, data.task, NAMES, {"curve": [data.task_latent]}, np.eye(1, dim)
        ),
    ):
        assert image.startswith(b"\x89PNG")


def test_figures_refuse_what_they_cannot_draw() -> None:
    with pytest.raises(BMRLError, match="no curve"):
        stage1_curves({})
    with pytest.raises(BMRLError, match=r"\[0, 6\).*7"):
        embedding_scatter(np.zeros((1, 2)), np.array([7]), NAMES)
    with pytest.raises(BMRLError, match="at least 4"):
        embedding_tsne(np.zeros((3, 2)), np.zeros(3, dtype=int), NAMES)
    with pytest.raises(BMRLError, match="no trajectory"):
        trajectories(np.zeros((0, 2)), np.zeros(0, dtype=int), np.zeros(0))
    with pytest.raises(BMRLError, match="no trajectory"):
        behaviour_trajectories({}, {})


@pytest.mark.parametrize(
    ("returns", "expert", "low", "high"),
    [
        ([-5.0, -1.0], None, -5.0, 0.0),
        ([-5.0, -1.0], -20.0, -20.0, 0.0),
        ([198.0, 198.1], None, 0.0, 198.1),
        ([300.0, 310.0], 400.0, 0.0, 400.0),
    ],
)
def test_the_axes_of_curves_include_zero_and_have_a_margin_around_the_returns(
    returns: list[float],
    expert: float | None,
    low: float,
    high: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr("torchrl_bmrl.reports.figures.png", lambda figure: drawn.append(figure))
    expert_means = None if expert is None else {"still": expert}
    stage1_curves({"still": [(1, 10, np.array(returns))]}, expert_means=expert_means)
    bottom, top = drawn[0].axes[0].get_ylim()
    margin = 0.03 * (high - low)
    assert bottom == 0 if low == 0 else bottom < low - margin
    assert top == 0 if high == 0 else top > high + margin
