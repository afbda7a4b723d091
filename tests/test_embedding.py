"""What is measured on the embedding is what it says, and does not depend on what it should not."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

for extra in ("scipy", "sklearn"):
    pytest.importorskip(extra)

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.embedding import (
    STAGE_TAIL,
    distance_correlations,
    find_stages,
    mean_estimate,
    spread_ratio,
    stage_agreement,
    until_success,
)


def three_stages(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of three long, thin stages one after the other; phase and episode of each."""
    rng = np.random.default_rng(seed)
    episode, phase, progress = (
        a.ravel() for a in np.meshgrid(range(6), range(3), np.linspace(0, 1, 12), indexing="ij")
    )
    corners = np.array([[0.0, 0.0], [4.0, 0.5], [4.5, 5.0]])
    ways = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0]])
    points = corners[phase] + progress[:, None] * ways[phase]
    return points + 0.1 * rng.normal(size=points.shape), phase, episode


def rotation(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def mutual_information(first: np.ndarray, second: np.ndarray) -> float:
    """From counts alone [nat]."""
    n, pairs = len(first), Counter(zip(first.tolist(), second.tolist(), strict=True))
    a, b = Counter(first.tolist()), Counter(second.tolist())
    return sum(c / n * math.log(n * c / (a[i] * b[j])) for (i, j), c in pairs.items())


# The way to success


def test_what_follows_the_first_success_is_left_out_in_any_order() -> None:
    episode = np.repeat([0, 1, 2], 5)
    step = np.tile(np.arange(5), 3)
    success = np.array([0, 0, 1, 0, 1] + [0] * 5 + [1, 0, 0, 0, 0], dtype=bool)
    expected = np.array([1, 1, 1, 0, 0] + [1] * 5 + [1, 0, 0, 0, 0], dtype=bool)
    longer = np.array([1, 1, 1, 1, 0] + [1] * 5 + [1, 1, 0, 0, 0], dtype=bool)
    assert (until_success(success, episode, step, tail=1) == longer).all()
    order = np.random.default_rng(0).permutation(15)
    assert (until_success(success, episode, step) == expected).all()
    assert (until_success(success[order], episode[order], step[order]) == expected[order]).all()


# Stages


def test_stages_that_lie_apart_are_found() -> None:
    points, phase, episode = three_stages()
    held_out, its_phase, its_episode = three_stages(seed=1)
    stage = find_stages(points, held_out, 3)
    assert stage_agreement(stage, its_phase, its_episode).value > 0.95
    assert set(find_stages(points, points, 3)) == {0, 1, 2}
    assert len(phase) == len(episode) == len(points)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_stages_do_not_depend_on_where_the_embedding_lies_and_how_it_is_turned(
    scale: float,
) -> None:
    points, _, episode = three_stages()
    moved = scale * points @ rotation(0.7) + 100.0 * scale
    assert stage_agreement(
        find_stages(points, points, 3), find_stages(moved, moved, 3), episode
    ).value == pytest.approx(1.0)


def test_stages_of_equal_points_are_equal() -> None:
    points, _, _ = three_stages()
    assert (find_stages(points, points, 3) == find_stages(points, points, 3)).all()
    one_at_a_time = [find_stages(points, point[None], 3)[0] for point in points[:20]]
    assert one_at_a_time == find_stages(points, points, 3)[:20].tolist()


def test_clusters_that_equal_phases_give_one_whatever_their_names() -> None:
    _, phase, episode = three_stages()
    estimate = stage_agreement((phase + 1) % 3, phase, episode)
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((1.0, 1.0, 1.0))


def test_clusters_by_chance_give_about_nothing_however_many() -> None:
    _, phase, _ = three_stages()
    episode = np.zeros(len(phase), int)  # the intervals are not read
    rng = np.random.default_rng(0)
    for groups in (2, 3, 20):
        values = [
            stage_agreement(rng.integers(groups, size=len(phase)), phase, episode)
            for _ in range(20)
        ]
        assert abs(np.mean([v.value for v in values])) < 0.01


def test_agreement_is_mutual_information_above_chance_over_mean_entropy() -> None:
    rng = np.random.default_rng(2)
    phase = np.repeat([0, 1, 2], [40, 25, 15])
    stage = np.where(rng.random(80) < 0.7, phase, rng.integers(3, size=80))
    # Chance: the mean over shuffles, which keep both sizes.
    chance = np.mean([mutual_information(phase, rng.permutation(stage)) for _ in range(4000)])
    entropy = (mutual_information(phase, phase) + mutual_information(stage, stage)) / 2
    expected = (mutual_information(phase, stage) - chance) / (entropy - chance)
    measured = stage_agreement(stage, phase, np.arange(80)).value
    assert measured == pytest.approx(expected, abs=2e-3)
    assert 0.2 < measured < 0.8


def test_the_interval_is_over_episodes_not_transitions() -> None:
    _, phase, episode = three_stages()
    # Of half of the episodes the groups know everything, of the others nothing.
    stage = np.where(episode < 3, phase, 0)
    whole = stage_agreement(stage, phase, episode)
    apart = stage_agreement(stage, phase, np.arange(len(episode)))
    assert whole.value == apart.value
    assert whole.low < whole.value < whole.high
    assert whole.high - whole.low > 2 * (apart.high - apart.low)


def test_an_interval_evaluates_each_combination_of_episodes_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import sklearn.metrics

    seen: list[tuple[int, ...]] = []
    score = sklearn.metrics.adjusted_mutual_info_score

    def record(phase: np.ndarray, stage: np.ndarray) -> float:
        seen.append(tuple(stage.tolist()))
        return float(score(phase, stage))

    monkeypatch.setattr(sklearn.metrics, "adjusted_mutual_info_score", record)
    # The groups are the episodes' numbers, so that they tell which were drawn.
    episode = np.repeat([0, 1, 2], 4)
    stage_agreement(episode, np.tile([0, 1, 0, 1], 3), episode)
    # Ten combinations of three episodes, and all rows once more for the value.
    assert len(seen) == 11
    assert len(set(seen)) == 10


def test_an_interval_counts_a_combination_as_often_as_it_is_drawn() -> None:
    from sklearn.metrics import adjusted_mutual_info_score

    _, phase, episode = three_stages()
    stage = np.where(episode < 3, phase, 0)
    drawn = []
    for draw in np.random.default_rng(0).integers(6, size=(200, 6)):
        rows = np.concatenate([np.flatnonzero(episode == number) for number in draw])
        drawn.append(adjusted_mutual_info_score(phase[rows], stage[rows]))
    measured = stage_agreement(stage, phase, episode, seed=0)
    expected = np.quantile(drawn, [0.025, 0.975])
    assert (measured.low, measured.high) == pytest.approx(tuple(expected))


# Distance to the goal


def test_circles_around_the_success_point_give_one_and_their_reverse_minus_one() -> None:
    rng = np.random.default_rng(0)
    distance = rng.uniform(0.02, 0.3, size=60)
    angle = rng.uniform(0, 2 * np.pi, size=60)
    center = np.array([3.0, -2.0])
    # Any growing function of the distance: ranks are compared.
    around = center + (distance**3)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    episode = np.repeat([4, 7, 9], 20)
    assert distance_correlations(around, center, distance, episode) == pytest.approx(np.ones(3))
    assert distance_correlations(around, center, -distance, episode) == pytest.approx(-np.ones(3))


def test_correlations_equal_those_of_ranks() -> None:
    rng = np.random.default_rng(1)
    latent, distance = rng.normal(size=(30, 3)), rng.random(30)
    ranks = [np.argsort(np.argsort(x)) for x in (np.linalg.norm(latent - 1.0, axis=1), distance)]
    expected = np.corrcoef(*ranks)[0, 1]
    measured = distance_correlations(latent, np.ones(3), distance, np.zeros(30))
    assert measured == pytest.approx([expected])


def test_correlations_do_not_depend_on_how_the_embedding_is_turned_and_scaled() -> None:
    rng = np.random.default_rng(1)
    latent, distance, episode = rng.normal(size=(40, 2)), rng.random(40), np.arange(40) % 4
    turn = 7.0 * rotation(1.1)
    assert distance_correlations(latent, [1.0, 2.0], distance, episode) == pytest.approx(
        distance_correlations(latent @ turn + 5.0, [1.0, 2.0] @ turn + 5.0, distance, episode)
    )


def test_an_episode_that_tells_nothing_counts_as_nothing() -> None:
    latent = np.array([[1.0], [1.0], [3.0], [0.0], [2.0]])
    found = distance_correlations(latent, [0.0], [0.1, 0.2, 0.3, 0.0, 0.5], [0, 0, 1, 2, 2])
    assert found == pytest.approx([0.0, 0.0, 1.0])


def test_spread_is_the_root_mean_squared_distance_from_the_mean() -> None:
    rng = np.random.default_rng(3)
    start, end = rng.normal(size=(9, 3)), 0.2 * rng.normal(size=(9, 3))
    pairs = [  # over all pairs, which needs no mean
        math.sqrt(sum(((a - b) ** 2).sum() for a in x for b in x) / (2 * 81)) for x in (start, end)
    ]
    ratio = spread_ratio(start, end)
    assert ratio.value == pytest.approx(pairs[1] / pairs[0])
    assert ratio.low <= ratio.value <= ratio.high
    turned = spread_ratio(5.0 * start - 1.0, 5.0 * end + 9.0)
    assert turned.value == pytest.approx(ratio.value)


def test_a_mean_over_episodes_lies_in_its_interval() -> None:
    estimate = mean_estimate([0.9, 0.5, 0.7, 0.8])
    assert estimate.value == pytest.approx(0.725)
    assert 0.5 <= estimate.low < estimate.value < estimate.high <= 0.9


# What is refused


def test_what_does_not_fit_is_refused_by_name() -> None:
    points, phase, episode = three_stages()
    flat = np.zeros(3)
    with pytest.raises(BMRLError, match=r"step has the shape \(2,\); valid: \(3,\)"):
        until_success(flat, flat, flat[:2])
    with pytest.raises(BMRLError, match="num_stages is 0; valid: 1 to 216"):
        find_stages(points, points, 0)
    with pytest.raises(BMRLError, match="points have the size 1; valid: 2"):
        find_stages(points, points[:, :1], 3)
    with pytest.raises(BMRLError, match="training must be finite"):
        find_stages(np.full((9, 2), np.nan), points, 3)
    with pytest.raises(BMRLError, match=r"phase has the shape \(215,\); valid: \(216,\)"):
        stage_agreement(phase, phase[1:], episode)
    with pytest.raises(BMRLError, match="N above 0"):
        stage_agreement(phase[:0], phase[:0], episode[:0])
    with pytest.raises(BMRLError, match=r"success_point is \[0.0\]; valid: 2 finite numbers"):
        distance_correlations(points, [0.0], phase, episode)
    with pytest.raises(BMRLError, match="distance must be finite"):
        distance_correlations(points, [0.0, 0.0], np.full(216, np.inf), episode)
    with pytest.raises(BMRLError, match=r"end has the shape \(2, 2\); valid: \(3, 2\)"):
        spread_ratio(points[:3], points[:2])
    with pytest.raises(BMRLError, match="start is one point 2 times"):
        spread_ratio(points[[0, 0]], points[:2])


def test_stages_are_looked_for_in_successful_episodes_alone() -> None:
    pytest.importorskip("matplotlib")
    from torchrl_bmrl.reports import Embeddings

    episode, step = (a.ravel() for a in np.meshgrid(range(3), range(40)))
    zeros = np.zeros(episode.size, dtype=int)
    embeddings = Embeddings(
        tasks=["reach", "lift"],
        task_latent=np.zeros((episode.size, 2)),
        task=zeros + 1,
        episode=episode,
        step=step,
        distance=zeros,
        success=(step >= 20) & (episode != 1),
    )
    found = embeddings.in_stages("lift")
    assert set(found.episode) == {0, 2}
    assert found.step.max() == 20 + STAGE_TAIL
    assert len(embeddings.in_stages("reach").task) == 0
