"""Constant, single and empty data: finite numbers without a warning, or an error of the library."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("scipy")
pytest.importorskip("sklearn")

from episode_files import TASK_PARTS, make_episode
from helpers import make_distillation_loss
from tensordict import TensorDict
from torchrl.envs.transforms import ObservationNorm

from torchrl_bmrl.envs.transforms import ObservationStatistics
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.behaviour import matching_noise, mean_speed
from torchrl_bmrl.evaluation.embedding import (
    distance_correlations,
    find_stages,
    mean_estimate,
    spread_ratio,
    stage_agreement,
)
from torchrl_bmrl.evaluation.paths import data_path
from torchrl_bmrl.evaluation.statistics import (
    Estimate,
    bootstrap_interval,
    probability_of_improvement,
    rank_correlation,
    relative_difference,
)
from torchrl_bmrl.functional import mean_and_scale
from torchrl_bmrl.tasks import get_task

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


# -- mean and scale --------------------------------------------------------------------------------

CONSTANTS = {
    "zeros": np.zeros(50),
    "a constant": np.full(50, 0.1),
    "a large constant": np.full(50, 1e12 + 1 / 3),
    "rounding around a constant": 0.1 + 1e-17 * RNG.normal(size=50),
    "the last place of a constant": np.nextafter(0.7, np.repeat([0.0, 1.0], 25)),
    "rounding around zero": 1e-17 * RNG.normal(size=50),
    "a simulator's noise at rest": 1e-13 * RNG.normal(size=50),
    "float32 rounding": np.nextafter(np.float32(0.7), np.repeat([0, 1], 25).astype(np.float32)),
    "float32 noise": (3e-8 * RNG.normal(size=50)).astype(np.float32),
    "float16": np.full(50, 0.1, np.float16),
    "one row": np.array([0.3]),
}


@pytest.mark.parametrize("values", CONSTANTS.values(), ids=CONSTANTS)
def test_the_scale_of_a_constant_is_one(values: np.ndarray) -> None:
    loc, scale = mean_and_scale(torch.as_tensor(values).unsqueeze(-1))
    assert (loc.dtype, scale.tolist()) == (torch.float64, [1.0])
    np.testing.assert_allclose(loc.item(), values.astype(float).mean(), rtol=1e-6, atol=1e-6)


def exact(values: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation in rational numbers, rounded once."""
    numbers = [Fraction(float(value)) for value in values]
    mean = sum(numbers) / len(numbers)
    square = sum((number - mean) ** 2 for number in numbers) / len(numbers)
    large = max(abs(number) for number in numbers)
    return float(mean), float(large) * float(square / large**2) ** 0.5


VARIED = {
    "standard": RNG.normal(size=1000),
    "a small spread around a large number": 1e9 + 1e-3 * RNG.normal(size=1000),
    "float32 around a large number": (1e4 + RNG.normal(size=1000)).astype(np.float32),
    "small numbers": 1e-9 * RNG.normal(size=1000),
    "small float32 numbers": (1e-5 * RNG.normal(size=1000)).astype(np.float32),
    "one that differs": np.append(np.full(999, 0.5), 0.6),
    "a first one far off": np.append(1e6, RNG.normal(size=999)),
    "numbers with infinite squares": 1e300 * RNG.normal(size=1000),
    "numbers with an infinite sum": np.full(1000, 1.7e308) * (np.arange(1000) % 2),
    "two rows": np.array([1.0, 2.0]),
}


@pytest.mark.parametrize("values", VARIED.values(), ids=VARIED)
def test_mean_and_scale_are_those_of_exact_arithmetic(values: np.ndarray) -> None:
    loc, scale = mean_and_scale(torch.as_tensor(values).unsqueeze(-1))
    mean, deviation = exact(values)
    np.testing.assert_allclose(loc.item(), mean, rtol=1e-13, atol=1e-13 * deviation)
    np.testing.assert_allclose(scale.item(), deviation, rtol=1e-9)


def test_dimensions_do_not_disturb_each_other_and_parts_add_up() -> None:
    values = np.stack(
        [np.full(200_000, 3.0), RNG.normal(size=200_000), 1e200 * RNG.random(200_000)]
    )
    loc, scale = mean_and_scale(torch.as_tensor(values.T))
    assert scale[0] == 1
    np.testing.assert_allclose(loc.numpy(), values.mean(1), rtol=1e-9)
    np.testing.assert_allclose(scale[1].item(), values[1].std(), rtol=1e-9)
    np.testing.assert_allclose(scale[2].item(), 1e200 * (values[2] / 1e200).std(), rtol=1e-9)


def test_a_data_set_s_statistics_normalise_constant_dimensions_to_zero(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    from dataclasses import replace

    from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
    from torchrl_bmrl.data.robomimic import write_episodes

    still = {name: np.full((5, 3), 0.1) for name in ("still", "noisy")}
    still["noisy"] += 1e-17 * RNG.normal(size=(5, 3))
    still["still"][:, 2] = np.arange(5)
    episode = replace(make_episode(), observations=still, next_observations=still)
    episode.actions[:, :6] = 0  # a gripper alone moves
    write_episodes(tmp_path / "a.hdf5", [episode, episode], env_args={})
    replay = RobomimicExperienceReplay(tmp_path / "a.hdf5")
    statistics = replay.metadata["statistics"]
    assert statistics["noisy"]["scale"] == [1, 1, 1]
    assert statistics["still"]["scale"] == [1, 1, pytest.approx(2**0.5)]
    assert statistics["action"]["scale"][:6] == [1] * 6
    data = replay[:].clone()
    for key, values in statistics.items():
        given = {name: torch.tensor(values[name]) for name in ("loc", "scale")}
        normalised = ObservationNorm(**given, in_keys=[key], standard_normal=True)(data)[key]
        assert normalised.isfinite().all()
        assert normalised.abs().max() < 10
        constant = torch.tensor(values["scale"]) == 1
        assert normalised[:, constant].abs().max() < 1e-6


def task_data(value: float, rows: int = 6) -> TensorDict:
    parts = {name: torch.full((rows, *shape), value) for name, (shape, _) in TASK_PARTS.items()}
    return TensorDict(parts, [rows])


@pytest.mark.parametrize("rows", [1, 6])
def test_observations_that_never_change_have_the_scale_one(rows: int) -> None:
    tasks = [get_task("reach"), get_task("lift")]
    same = ObservationStatistics.of([task_data(0.3, rows), task_data(0.3, rows)], tasks)
    assert same.scale.tolist() == [1.0] * 33
    # Constant in each task, and not over both.
    apart = ObservationStatistics.of([task_data(0.3, rows), task_data(0.5, rows)], tasks)
    torch.testing.assert_close(apart.scale[-3:], torch.full((3,), 0.1))
    little = ObservationStatistics.of([task_data(0.3, rows), task_data(0.3 + 1e-5, rows)], tasks)
    torch.testing.assert_close(little.scale[-3:], torch.full((3,), 1e-3))


def test_statistics_of_constant_demonstrations_can_be_read_back(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    from dataclasses import replace

    from torchrl_bmrl.data.demonstrations import (
        load_transitions,
        read_statistics,
        write_statistics,
    )
    from torchrl_bmrl.data.robomimic import write_episodes

    parts = {name: np.full((5, *shape), 0.1) for name, (shape, _) in TASK_PARTS.items()}
    episode = replace(make_episode(), observations=parts, next_observations=parts)
    write_episodes(tmp_path / "lift.hdf5", [episode], env_args={}, masks={"train": [0]})
    lift = get_task("lift")
    write_statistics(tmp_path, [lift])
    for statistics in (read_statistics(tmp_path), read_statistics(tmp_path, lift)):
        assert statistics.scale.tolist() == [1.0] * 33
        data = load_transitions(tmp_path, lift, statistics, split="train", index=1)
        assert data["observation"].abs().max() < 1e-6


@pytest.mark.parametrize("name", ["qvalue_loc", "qvalue_scale", "reward_scale"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_loss_refuses_numbers_that_it_cannot_normalise_with(name: str, value: float) -> None:
    with pytest.raises(BMRLError, match=f"{name} is .*valid: a finite number"):
        make_distillation_loss(**{name: torch.tensor([1.0, value, 1.0])})


@pytest.mark.parametrize("values", [[2.0], [0.0, 0.0], [0.1, 0.1, 0.1]])
def test_stage_2_divides_by_one_where_rewards_are_all_the_same(
    values: list[float],
) -> None:
    for package in ("h5py", "gymnasium", "safetensors", "tqdm"):
        pytest.importorskip(package)
    from torchrl_bmrl.pipeline.training_data import deviation

    assert deviation(torch.tensor(values).unsqueeze(-1)).item() == 1.0
    varied = torch.tensor([[1.0], [3.0]])
    assert torch.equal(deviation(varied), varied.std())


# -- evaluation ------------------------------------------------------------------------------------

POINTS = {
    "zeros": np.zeros((20, 3)),
    "a constant": np.full((20, 3), 0.1),
    "a point": np.tile([0.1, 0.2, 0.3], (20, 1)),
    "rounding around a constant": 0.1 + 1e-17 * RNG.normal(size=(20, 3)),
    "rounding around zero": 1e-17 * RNG.normal(size=(20, 3)),
    "two points": np.repeat([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 10, axis=0),
    "a line": np.linspace(0, 1, 20)[:, None] * np.ones(3),
}


def finite(value: Any) -> bool:
    if isinstance(value, Estimate):
        value = [value.value, value.low, value.high]
    return bool(np.isfinite(np.asarray(value, dtype=float)).all())


MEASURES: dict[str, Callable[[np.ndarray], Any]] = {
    "stages": lambda x: find_stages(x, x, 3),
    "stages of others": lambda x: find_stages(x, x + 5, 2),
    "agreement": lambda x: stage_agreement(find_stages(x, x, 2), np.zeros(20), np.arange(20) // 10),
    "distances": lambda x: distance_correlations(x, x[0], np.arange(20.0), np.arange(20) // 5),
    "goal at rest": lambda x: distance_correlations(x, x[0], np.zeros(20), np.arange(20) // 5),
    "spread": lambda x: spread_ratio(x, x),
    "mean": lambda x: mean_estimate(x[:, 0]),
    "interval": lambda x: bootstrap_interval(x[:, 0], strata=np.arange(20) // 10),
    "one episode": lambda x: bootstrap_interval(x[:1, 0]),
    "rank correlation": lambda x: rank_correlation(x[:, 0], np.arange(20)),
    "relative difference": lambda x: relative_difference(x[:, 1], x[:, 0]),
    "improvement": lambda x: probability_of_improvement(x[:, 0], x[:, 1]),
    "improvement of one": lambda x: probability_of_improvement(x[:1, 0], x[:1, 1]),
    "path": lambda x: data_path(x, x[0], x[-1], 5),
    "speed": lambda x: mean_speed(x[None], 0.05),
    "noise": lambda x: matching_noise(np.clip(x, -1, 1), 0.0),
}


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("points", POINTS)
def test_measures_of_degenerate_points_are_finite_or_refused(measure: str, points: str) -> None:
    for package in ("scipy", "sklearn"):
        pytest.importorskip(package)
    none = {  # no spread to divide by, no mean return above 0
        "spread": ("zeros", "a constant", "a point"),
        "relative difference": ("zeros", "rounding around zero"),
    }
    if points in none.get(measure, ()):
        with suppress(BMRLError):  # of rounding, there may be a positive mean
            assert finite(MEASURES[measure](POINTS[points]))
    else:
        assert finite(MEASURES[measure](POINTS[points]))


@pytest.mark.parametrize("points", ["zeros", "a constant", "a point"])
def test_points_that_are_one_form_one_group(points: str) -> None:
    pytest.importorskip("sklearn")
    assert find_stages(POINTS[points], POINTS[points] + RNG.normal(size=(20, 3)), 3).max() == 0
    assert set(find_stages(POINTS["two points"], POINTS["two points"], 3)) == {0, 1}


def test_a_difference_in_sparse_returns_has_an_interval() -> None:
    pytest.importorskip("scipy")
    theirs = np.array([0.0] * 9 + [1.0])  # a third of all resamples hold no return at all
    same = relative_difference(theirs, theirs)
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0)
    more = relative_difference(np.array([1.0] * 2 + [0.0] * 7 + [1.0]), theirs)
    assert more.value == 2
    assert finite(more)
    assert 0 <= more.low <= 2 <= more.high


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e-15])
def test_a_path_takes_short_hops_however_short(scale: float) -> None:
    """The corner is data; the straight way is one long hop, which costs more."""
    pytest.importorskip("scipy")
    side = np.linspace(0, 1, 40)
    corner = np.concatenate([np.stack([0 * side, side], 1), np.stack([side, 0 * side + 1], 1)])
    path = data_path(scale * corner, [0, 0], [scale, scale], 201) / scale
    assert np.minimum(np.abs(path[:, 0]), np.abs(path[:, 1] - 1)).max() < 0.1


# -- the report ------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", POINTS)
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("rows", [1, 2, 20])
def test_pictures_of_degenerate_embeddings_are_drawn(points: str, dim: int, rows: int) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("sklearn")
    from torchrl_bmrl.reports import drawing, embedding_figures

    x = POINTS[points][:rows, :dim]
    plane, note = drawing.plane(x)
    assert plane.shape == (rows, 2)
    assert finite(plane)
    assert "nan" not in note
    task, episode = np.arange(rows) % 6, np.arange(rows) // 10
    if rows == 20:
        assert finite(drawing.tsne(x, 0)[1])
    if rows != 2:  # the drawing itself takes time
        titles = list("abcdef")
        embedding_figures.embedding_scatter(x, task, titles)
        embedding_figures.embedding_trajectories(
            x, episode, np.zeros(rows), title="Reach", success_point=x[0]
        )
        embedding_figures.embedding_paths(x, task, titles, {"straight": [x[:2]]}, x[:1])


@pytest.mark.parametrize("rows", [1, 3, 4])
def test_a_report_of_few_transitions_lacks_only_the_map_that_needs_more(
    tmp_path: Path, rows: int
) -> None:
    for package in ("jinja2", "matplotlib", "scipy", "sklearn"):
        pytest.importorskip(package)
    from torchrl_bmrl.reports import Embeddings, Explorer, write_report

    step, zeros = np.arange(rows), np.zeros(rows, dtype=int)
    data = Embeddings(
        tasks=["reach", "lift"],
        task_latent=np.stack([step, -(step**2)], axis=1) / rows,
        task=step % 2,
        episode=zeros,
        step=step,
        distance=1.0 - step / rows,
        success=step > 0,
        phase=step // 2,
        phase_names={"reach": ("descend", "hold"), "lift": ("descend", "hold")},
        baselines={"raw transition": np.eye(rows, 3)},
    )
    names = ("task_latent", "task", "episode", "step", "distance", "success")
    columns = {name: getattr(data, name) for name in names}
    explorer = Explorer(titles=["Reach", "Lift"], phase=["hold"] * rows, **columns)
    page = write_report(tmp_path, facts={}, embeddings=data, training=data, explorer=explorer)
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {"embedding", "embedding_trajectories"} <= drawn
    assert ("embedding_tsne" in drawn) == (rows >= 4)
    assert ("t-SNE map is left out" in page.read_text(encoding="utf-8")) == (rows < 4)


def test_pictures_of_returns_that_are_all_the_same_are_drawn() -> None:
    pytest.importorskip("matplotlib")
    from torchrl_bmrl.reports import figures

    for returns in (np.zeros(1), np.zeros(5), -np.ones(5)):
        figures.stage1_curves({"reach": [(1, 1, returns)]}, expert_means={"reach": 0.0})
    figures.success_curves({"a": [np.array([[0, 0.0]])]}, title="one evaluation")
    with pytest.raises(BMRLError, match="no curve"):
        figures.success_curves({"a": []}, title="none")


def test_tables_leave_out_shares_of_a_return_that_is_not_positive() -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("scipy")
    import published_data  # noqa: F401 -- makes the scripts of docs/results importable

    # isort: split
    import comparisons

    from torchrl_bmrl.evaluation.results import ResultRow, summarise

    rows = [
        ResultRow(
            task=task,
            policy=policy,
            seed=1,
            episode=i,
            episode_return=0.0 if task == "lift" else 1.0,
            success=False,
        )
        for task in comparisons.TASKS
        for policy in ("expert", "bcq")
        for i in range(3)
    ]
    bcq, expert = comparisons.BCQ, comparisons.EXPERT
    assert comparisons.difference(rows, rows, bcq, expert, ["lift"]) is None
    assert comparisons.difference(rows, rows, bcq, expert) is None
    assert comparisons.difference(rows, rows, bcq, expert, ["reach"]) is not None
    text = [
        comparisons.differences_table(rows, [bcq]).markdown(level=3),
        comparisons.policies_table(
            rows, summarise(rows), {bcq: "BCQ"}, expert, title="T", caption="C"
        ).markdown(level=3),
        comparisons.gains_table(rows, [(bcq, expert)]).markdown(level=3),
        comparisons.seeds_table(rows, []).markdown(level=3),
    ]
    assert "nan" not in "".join(text)
    assert "inf" not in "".join(text).replace("information", "")
