"""Figures draw the numbers that they are given: read back from the axes."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from torchrl_bmrl.reports import embedding_figures, figures


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that were drawn."""
    found: list[Any] = []
    for module in (figures, embedding_figures):
        monkeypatch.setattr(module, "png", lambda figure: found.append(figure) or b"")
    return found


def test_a_training_curve_has_its_mean_its_band_and_its_experts_line(drawn: list[Any]) -> None:
    returns = [np.array([10.0, 30.0]), np.array([40.0, 40.0])]
    curve = [(epoch, 50 * epoch, values) for epoch, values in enumerate(returns, start=1)]
    figures.stage1_curves({"lift": curve}, expert_means={"lift": 35.0})
    (axes,) = drawn[0].axes
    mean, expert = (line for line in axes.lines if line.get_alpha() != 0)  # one is invisible
    assert_allclose(mean.get_xydata(), [[1, 20], [2, 40]])
    assert_allclose(expert.get_ydata(), 35)
    band = axes.collections[0].get_paths()[0].vertices
    assert sorted({y for x, y in band if x == 1}) == [10, 30]
    assert {y for x, y in band if x == 2} == {40}
    assert drawn[0].get_supxlabel() == "Epoch (50 updates each)"


def test_epochs_of_different_lengths_have_none_on_the_axis(drawn: list[Any]) -> None:
    curve = [(1, 50, np.ones(1)), (2, 150, np.ones(1))]
    figures.stage1_curves({"lift": curve})
    assert drawn[0].get_supxlabel() == "Epoch"


def test_the_thick_line_is_the_mean_over_seeds_at_the_steps_of_all(drawn: list[Any]) -> None:
    seeds = [np.array([[0, 0.0], [100, 1.0]]), np.array([[0, 0.0], [50, 0.0], [100, 0.0]])]
    figures.success_curves({"latent": seeds}, title="T")
    lines = drawn[0].axes[0].lines
    assert_allclose(lines[2].get_xydata(), [[0, 0.0], [50, 0.25], [100, 0.5]])
    assert_allclose(lines[0].get_xydata(), seeds[0])


def test_trajectories_are_seen_with_the_robots_left_to_the_left(drawn: list[Any]) -> None:
    paths = np.array([[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]])
    figures.behaviour_trajectories({"straight": paths}, {"straight": np.array([[0.5]])})
    above, behind = drawn[0].axes[:2]
    assert above.xaxis_inverted()
    assert behind.xaxis_inverted()
    assert_allclose(above.collections[1].get_offsets(), [[0.2, 0.1], [0.5, 0.4]])
    assert_allclose(behind.collections[1].get_offsets(), [[0.2, 0.3], [0.5, 0.6]])


def test_straight_paths_are_dashed_and_others_solid(drawn: list[Any]) -> None:
    paths = {"straight": [np.eye(2)], "curve": [2 * np.eye(2)]}
    embedding_figures.embedding_paths(np.eye(2), np.array([0, 1]), ["A", "B"], paths, np.eye(1, 2))
    styles = {
        tuple(line.get_xydata().ravel()): line.get_linestyle() for line in drawn[0].axes[0].lines
    }
    assert styles[1.0, 0.0, 0.0, 1.0] == "--"
    assert styles[2.0, 0.0, 0.0, 2.0] == "-"


def test_groups_take_the_colours_of_the_phases_that_they_share_most_with(drawn: list[Any]) -> None:
    points = np.random.default_rng(0).normal(size=(12, 2))
    phase = np.arange(12) % 3
    group = np.array([1, 2, 0])[phase]  # the same groups under other numbers
    embedding_figures.embedding_stages(points, phase, group, ["a", "b", "c"])
    left, right = (axes.collections[0].get_facecolors() for axes in drawn[0].axes[:2])
    assert_allclose(left, right)
    assert len(np.unique(left, axis=0)) == 3
