"""What a data set holds, everything that is wrong with it, and what deserves a look."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from episode_files import PARTS, changed, make_episode, with_array, write_file

from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.data.schema import arrays_of, find_problems
from torchrl_bmrl.data.summary import Summary, is_continuous, summarise
from torchrl_bmrl.errors import DataError

STEPS = 5


# -- a data set ------------------------------------------------------------------------------------


def summary_of(*episodes: Episode, **options: Any) -> Summary:
    return summarise({f"demo_{i}": e for i, e in enumerate(episodes)}, **options)


def varied(count: int = 3, **options: Any) -> list[Episode]:
    return [make_episode(i, STEPS + i, **options) for i in range(count)]


def test_a_summary_tells_lengths_returns_successes_and_ends() -> None:
    episodes = varied()
    episodes[1] = make_episode(1, STEPS + 1, terminated=True)
    episodes[2] = with_array(episodes[2], "successes", np.zeros(STEPS + 2, bool))
    summary = summary_of(*episodes)
    assert (summary.problems, summary.warnings) == ([], [])
    assert summary.lengths == [STEPS, STEPS + 1, STEPS + 2]
    assert summary.returns == pytest.approx([e.rewards.sum() for e in episodes])
    assert summary.successes == [True, True, False]
    assert summary.terminated == 1


def test_success_is_unknown_where_no_episode_tells() -> None:
    assert summary_of(*(replace(e, extras={}) for e in varied())).successes == []


def test_a_summary_tells_the_range_of_each_dimension_over_all_episodes() -> None:
    episodes = varied()
    summary = summary_of(*episodes)
    assert list(summary.ranges) == ["actions", *PARTS]
    for key, extent in summary.ranges.items():
        name = key if key == "actions" else f"obs/{key}"
        whole = np.concatenate([arrays_of(episode)[name] for episode in episodes])
        np.testing.assert_array_equal(extent.low, whole.min(0))
        np.testing.assert_array_equal(extent.high, whole.max(0))
        assert extent.dtype == str(whole.dtype)


def test_a_summary_lists_all_problems_of_all_episodes() -> None:
    bad = with_array(
        changed("rewards", 1, np.nan), "actions", np.full_like(make_episode().actions, 2)
    )
    bad = replace(bad, terminated=np.ones(STEPS, bool))
    keys = [key for key, _ in find_problems(bad)]
    assert sorted(keys) == ["actions", "rewards", "terminated"]
    summary = summary_of(make_episode(), bad, make_episode(1), bad, prefix="data/")
    assert [key for key, _ in summary.problems] == [
        f"data/demo_{i}/{key}" for i in (1, 3) for key in keys
    ]
    assert len(summary.lengths) == 2


def test_episodes_that_cannot_be_read_do_not_hide_the_others() -> None:
    episodes: Mapping[str, Any] = {
        "a": DataError("x.hdf5", "data/a/actions", "missing"),
        "b": make_episode(),
        "c": changed("rewards", 1, np.nan),
        "d": DataError("x.hdf5", None, "gone"),
    }

    def read(name: str) -> Episode:
        if isinstance(episodes[name], DataError):
            raise episodes[name]
        return episodes[name]

    looked: list[tuple[str, bool]] = []
    summary = summarise(
        LazyEpisodes(episodes, read),
        prefix="data/",
        look=lambda name, episode: looked.append((name, episode is episodes[name])),
    )
    assert summary.problems == [
        ("data/a/actions", "missing"),
        ("data/c/rewards", "a value that is not finite in row 1"),
        ("", "gone"),
    ]
    assert summary.lengths == [STEPS]
    assert looked == [("a", False), ("b", True), ("c", True), ("d", False)]


def test_a_summary_of_a_damaged_file_lists_all_of_it(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    write_file(path)
    with h5py.File(path, "r+") as file:
        del file["data/demo_0/actions"]
        file["data/demo_2/rewards"][3] = np.inf
        del file["data/demo_3/obs/object"]
    with open_episodes(path) as episodes:
        summary = summarise(episodes, prefix="data/")
    assert [key for key, _ in summary.problems] == [
        "data/demo_0/actions",
        "data/demo_2/rewards",
        # Which parts are read is told by obs.
        "data/demo_3/next_obs/object",
        "data/demo_3/obs/object",
    ]


def test_episodes_are_compared_with_the_first_whole_one() -> None:
    other = make_episode(parts={"object": ((9,), np.float64), "image": PARTS["image"]})
    bad = changed("rewards", 1, np.nan)
    summary = summary_of(bad, other, make_episode())
    assert [key for key, _ in summary.problems] == [
        "demo_0/rewards",
        "demo_2/obs/object",
        "demo_2/next_obs/object",
    ]


def test_no_episodes_are_a_problem() -> None:
    assert summarise({}, prefix="data/").problems == [("data", "no episodes; valid: at least one")]


# -- warnings --------------------------------------------------------------------------------------


def warnings_of(episodes: Sequence[Episode], **options: Any) -> list[str]:
    summary = summary_of(*episodes, **options)
    assert summary.problems == []
    return summary.warnings


def test_whole_data_give_no_warning() -> None:
    assert warnings_of(varied()) == []
    assert warnings_of(varied(), bounds=None) == []
    assert warnings_of([make_episode(i, terminated=i == 0) for i in range(3)]) == []


def test_episodes_of_a_single_step_deserve_a_look() -> None:
    episodes = [*varied(), make_episode(8, 1), make_episode(9, 1)]
    assert warnings_of(episodes) == ["2 of 5 episodes have a single step"]


def test_terminations_after_equal_numbers_of_steps_may_be_a_horizon() -> None:
    (warning,) = warnings_of([make_episode(i, terminated=True) for i in range(3)])
    assert f"all 3 episodes terminate after exactly {STEPS} steps: is that a horizon?" in warning
    assert warnings_of(varied(terminated=True)) == []  # lengths differ
    assert warnings_of([make_episode(terminated=True)]) == []  # one alone says nothing


def test_constant_dimensions_are_named() -> None:
    def flatten(episode: Episode) -> Episode:
        part = episode.observations["object"].copy()
        after = episode.next_observations["object"].copy()
        part[:, [1, 4]] = after[:, [1, 4]] = 0.5
        episode = with_array(episode, "obs/object", part)
        return with_array(episode, "next_obs/object", after)

    episodes = [flatten(episode) for episode in varied()]
    assert warnings_of(episodes) == ["object: constant in dimensions 1, 4 of 10"]
    # Over all episodes, not within each.
    assert warnings_of([*episodes, make_episode(9)]) == []


def test_constant_parts_are_named_without_their_dimensions() -> None:
    dark = {name: np.zeros((STEPS, 8, 8, 3), np.uint8) for name in ("obs/image", "next_obs/image")}
    episodes = []
    for episode in (make_episode(0), make_episode(1)):
        for key, array in dark.items():
            episode = with_array(episode, key, array)
        episodes.append(episode)
    assert warnings_of(episodes) == ["image: constant in every dimension"]


def test_many_constant_dimensions_are_not_all_named() -> None:
    episodes = []
    for episode in varied():
        actions = episode.actions.repeat(2, axis=1)
        actions[:, :10] = 0
        episodes.append(replace(episode, actions=actions))
    (warning,) = warnings_of(episodes)
    assert warning == "actions: constant in dimensions 0, 1, 2, 3, 4, 5, 6, 7, ... of 14"


def test_saturated_actions_deserve_a_look() -> None:
    def saturate(episode: Episode, steps: int) -> Episode:
        actions = episode.actions.copy()
        actions[:steps, 6] = np.where(np.arange(steps) % 2, 1, -1)
        return replace(episode, actions=actions)

    episodes = [make_episode(i, 10) for i in range(2)]
    assert warnings_of([saturate(e, 5) for e in episodes]) == []
    expected = "actions: dimension 6 is at a bound in 60% of all steps"
    saturated = [saturate(e, 6) for e in episodes]
    assert warnings_of(saturated) == [expected]
    # In other units, too; and what is at 1 of 2 is at no bound.
    low, high = [-2.0] * 7, [1.0] * 6 + [4.0]
    scaled = [
        replace(e, actions=(np.add(high, low) + e.actions * np.subtract(high, low)) / 2)
        for e in saturated
    ]
    assert warnings_of(scaled, bounds=(low, high)) == [expected]
    assert warnings_of(saturated, bounds=(-2, 2)) == []


def test_discrete_actions_do_not_saturate() -> None:
    assert warnings_of([replace(e, actions=np.arange(len(e)).clip(0, 1)) for e in varied()]) == []


def test_the_same_episode_twice_deserves_a_look() -> None:
    episodes = [*varied(), make_episode(1, STEPS + 1)]
    assert warnings_of(episodes) == ["the same episode occurs 2 times: demo_1, demo_3"]
    # Equal actions alone are no repetition, nor equal observations.
    for key in ("actions", "observations"):
        other = replace(episodes[0], **{key: getattr(make_episode(9), key)})
        assert not any("same" in warning for warning in warnings_of([episodes[0], other]))


def test_observations_that_do_not_follow_each_other_deserve_a_look() -> None:
    def shuffle(episode: Episode) -> Episode:
        order = np.arange(len(episode))[::-1]
        for key, array in arrays_of(episode).items():
            episode = with_array(episode, key, array[order])
        return episode

    assert is_continuous(make_episode())
    assert not is_continuous(shuffle(make_episode()))
    episodes = varied()
    (warning,) = warnings_of([episodes[0], shuffle(episodes[1]), shuffle(episodes[2])])
    assert "in 2 episodes, such as demo_1: are their steps in order?" in warning


@pytest.mark.parametrize("value", [1.5, -1.5])
def test_actions_beyond_1_deserve_a_look_where_no_bounds_are_told(value: float) -> None:
    episodes = varied()
    actions = episodes[1].actions.copy()
    actions[2, 3] = value
    episodes[1] = replace(episodes[1], actions=actions)
    expected = "actions: outside [-1, 1]; give the loss their bounds"
    assert warnings_of(episodes, bounds=None) == [expected]
    assert warnings_of(episodes, bounds=(-2, 2)) == []


def test_reading_goes_one_episode_at_a_time() -> None:
    read: list[str] = []

    def make(name: str) -> Episode:
        read.append(name)
        return make_episode(len(read))

    def names() -> Iterator[str]:
        yield from ("a", "b")

    summarise(LazyEpisodes(names(), make))
    assert read == ["a", "b"]
