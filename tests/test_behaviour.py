"""Measures of behaviour against counts by hand; paths through an embedding."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

pytest.importorskip("scipy")

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.behaviour import (
    cube_outcomes,
    effective_number,
    group_coverage,
    matching_noise,
    mean_speed,
    occupied_cells,
    spread,
)
from torchrl_bmrl.evaluation.paths import PathError, data_path, straight_path, switched_path

RNG = np.random.default_rng(0)


# -- measures --------------------------------------------------------------------------------------


def test_cells_are_those_that_a_loop_over_positions_finds() -> None:
    positions = RNG.normal(size=(5, 40, 3))
    expected = {
        tuple(math.floor(x / 0.3) for x in position) for position in positions.reshape(-1, 3)
    }
    assert {tuple(cell) for cell in occupied_cells(positions, 0.3).tolist()} == expected
    assert len(occupied_cells(positions, 0.3)) == len(expected)


def test_a_group_covers_the_union_of_what_its_episodes_cover() -> None:
    # Episode i stays in cells of its own, i + 1 of them: only the sizes of the groups add up.
    positions = np.zeros((6, 10, 2))
    for i in range(6):
        positions[i, :, 0] = 100 * i + 0.5
        positions[i, : i + 1, 1] = np.arange(i + 1)
    covered = group_coverage(positions + 0.5, 1.0, group_size=2)
    assert covered.shape == (3,)
    # No episode is in two groups, and none is left out.
    assert covered.sum() == sum(max(1, i + 1) for i in range(6))
    assert group_coverage(positions, 1.0, group_size=6).tolist() == [21]


def test_groups_of_methods_with_as_many_episodes_hold_the_same_episodes() -> None:
    first, second = np.zeros((10, 1, 1)), np.zeros((10, 1, 1))
    first[3], second[3] = 1.0, -1.0
    a, b = (group_coverage(x, 0.5, group_size=2) for x in (first, second))
    assert a.tolist() == b.tolist()
    assert sorted(a) == [1, 1, 1, 1, 2]


def test_the_groups_are_drawn_at_random() -> None:
    first = np.zeros((10, 1, 1))
    first[:5] = 1.0
    drawn = {tuple(group_coverage(first, 0.5, group_size=2, seed=seed)) for seed in range(5)}
    assert len(drawn) > 1


def test_spread_is_the_root_of_the_summed_variances() -> None:
    points = RNG.normal(size=(30, 3)) * [1, 2, 3]
    assert spread(points) == pytest.approx(math.sqrt(points.var(axis=0).sum()))
    assert spread(points + 5) == pytest.approx(spread(points))


def test_speed_is_length_over_time_and_not_displacement() -> None:
    angle = np.linspace(0, 2 * np.pi, 1001)
    circle = 0.3 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    assert mean_speed(circle[None], 0.01) == pytest.approx([2 * np.pi * 0.3 / 10], rel=1e-4)


@pytest.mark.parametrize(
    ("end", "outcome"),
    [
        ((0.0, 0.0, 0.0), "still"),
        ((0.019, 0.0, 0.0), "still"),
        ((0.021, 0.0, 0.0), "up"),
        ((-0.03, 0.02, 0.0), "down"),
        ((0.02, 0.03, 0.0), "left"),
        ((0.0, -0.3, -0.8), "right"),
    ],
)
def test_the_cube_goes_where_it_ends(end: tuple[float, ...], outcome: str) -> None:
    displacement = np.zeros((1, 4, 3))
    displacement[0, -1] = end
    assert cube_outcomes(displacement) == [outcome]
    displacement[0, 1] = (0.0, 0.5, 0.049)  # what it passed does not count, but for a lift
    assert cube_outcomes(displacement) == [outcome]
    displacement[0, 1, 2] = 0.051
    assert cube_outcomes(displacement) == ["lifted"]


def test_effective_number_counts_frequent_outcomes_and_discounts_rare_ones() -> None:
    assert effective_number("abcd") == pytest.approx(4)
    assert effective_number("aaaa") == 1
    assert effective_number("a" * 99 + "b") == pytest.approx(0.99**-0.99 * 0.01**-0.01)


@pytest.mark.parametrize("size", [0.1, 0.7, 2.0])
def test_noise_of_a_size_moves_actions_by_that_size_within_the_bounds(size: float) -> None:
    actions = np.clip(RNG.normal(size=(20_000, 7)), -1, 1)
    sigma = matching_noise(actions, size)
    noisy = np.clip(actions + sigma * RNG.normal(size=actions.shape), -1, 1)
    assert np.linalg.norm(noisy - actions, axis=1).mean() == pytest.approx(size, rel=0.02)


def test_noise_cannot_move_actions_beyond_their_bounds() -> None:
    with pytest.raises(BMRLError, match=r"size is 6; valid: between 0 and 2.6"):
        matching_noise(np.zeros((100, 7)), 6)


@pytest.mark.parametrize(
    "measure",
    [
        lambda x: occupied_cells(x, 0.1),
        lambda x: group_coverage(x, 0.1, group_size=1),
        lambda x: spread(x[0]),
        lambda x: mean_speed(x, 0.05),
        cube_outcomes,
        lambda x: matching_noise(x[0], 0.1),
    ],
)
def test_measures_refuse_what_is_not_finite_or_empty(measure) -> None:  # type: ignore[no-untyped-def]
    positions = np.zeros((2, 3, 3))
    positions[0, 1, 2] = np.nan
    with pytest.raises(BMRLError, match="finite"):
        measure(positions)
    with pytest.raises(BMRLError):
        measure(np.zeros((1, 0, 3)))


def test_more_episodes_to_a_group_than_there_are_is_refused() -> None:
    with pytest.raises(BMRLError, match="groups 3 episodes"):
        group_coverage(np.zeros((2, 3, 3)), 0.1, group_size=3)


# -- paths -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_paths_lead_from_start_to_end_in_equal_steps(dim: int) -> None:
    start, end = RNG.normal(size=(2, dim))
    straight = straight_path(start, end, 7)
    np.testing.assert_allclose(np.diff(straight, axis=0), np.tile((end - start) / 6, (6, 1)))
    curve = data_path(RNG.normal(size=(50, dim)), start, end, 500)
    for path in (straight, curve):
        assert path.shape[1] == dim
        np.testing.assert_allclose(path[[0, -1]], [start, end])
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    # A step across a corner is shorter; the others are equal.
    assert np.quantile(steps, 0.25) == pytest.approx(steps.max(), rel=1e-6)


def test_the_path_on_the_data_is_the_cheapest_of_all_routes() -> None:
    data, start, end = RNG.uniform(size=(5, 2)), np.zeros(2), np.ones(2)

    def cost(route: tuple[int, ...]) -> float:
        corners = np.array([start, *data[list(route)], end])
        return float((np.linalg.norm(np.diff(corners, axis=0), axis=1) ** 3).sum())

    routes = [r for n in range(6) for r in itertools.permutations(range(5), n)]
    best = min(routes, key=cost)
    assert 0 < len(best) < 5
    path = data_path(data, start, end, 20_000)
    gaps = np.linalg.norm(path[:, None] - data[None], axis=-1).min(0)
    assert set(np.flatnonzero(gaps < 1e-4)) == set(best)


def test_the_path_on_the_data_goes_round_what_the_straight_one_crosses() -> None:
    angle = np.linspace(0, np.pi, 200)
    arc = np.stack([np.cos(angle), np.sin(angle)], -1)
    path = data_path(arc, arc[0], arc[-1], 50)
    np.testing.assert_allclose(np.linalg.norm(path, axis=1), 1, atol=1e-3)
    assert np.linalg.norm(straight_path(arc[0], arc[-1], 51), axis=1).min() < 1e-9
    # Copies of a point, and data equal to the ends, change nothing.
    np.testing.assert_allclose(data_path(np.tile(arc, (2, 1)), arc[0], arc[-1], 50), path)
    # Where a long hop costs no more than short ones there is no reason for a detour.
    np.testing.assert_allclose(data_path(arc, arc[0], arc[-1], 50, power=1.0)[:, 1], 0, atol=1e-9)


def test_without_data_or_without_distance_there_still_is_a_path() -> None:
    np.testing.assert_allclose(data_path(np.empty((0, 2)), [0, 0], [0, 2], 3)[1], [0, 1])
    assert data_path(np.eye(2), [0.0, 0.0], [0.0, 0.0], 3).tolist() == [[0.0, 0.0]] * 3


def test_a_switch_keeps_both_sequences_and_joins_them_in_equal_steps() -> None:
    first, second = np.zeros((20, 2)), np.ones((20, 2)) * [1, 2]
    path = switched_path(first, second, at=6, steps=4)
    np.testing.assert_array_equal(path[:6], first[:6])
    np.testing.assert_array_equal(path[10:], second[10:])
    np.testing.assert_allclose(path[5:11, 0], np.linspace(0, 1, 6))
    np.testing.assert_array_equal(
        switched_path(first, second, at=6, steps=0), np.vstack([first[:6], second[6:]])
    )


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: straight_path([0, 0], [0, 0, 0], 3), r"end has shape \(3,\); valid: \(2,\)"),
        (lambda: straight_path([0, np.nan], [0, 0], 3), "start .* finite"),
        (lambda: straight_path([0, 0], [1, 1], 1), "num_points is 1; valid: at least 2"),
        (lambda: data_path(np.ones((4, 3)), [0, 0], [1, 1], 3), r"data .*\(4, 3\); valid: \(N, 2"),
        (lambda: data_path(np.ones((4, 2)), [0, 0], [1, 1], 3, power=0.5), "power is 0.5"),
        (lambda: switched_path(np.ones((4, 2)), np.ones((5, 2)), at=1, steps=1), "equal shapes"),
        (lambda: switched_path(np.ones((4, 2)), np.ones((4, 2)), at=2, steps=2), "at . steps < T"),
        (lambda: switched_path(np.ones((4, 2)), np.ones((4, 2)), at=0, steps=2), "1 <= at"),
    ],
)
def test_paths_that_cannot_be_are_refused_by_name(build, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(PathError, match=says):
        build()
