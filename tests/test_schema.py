"""What keeps data from being trained on, all of it, and what deserves a look."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from episode_files import PARTS, make_episode, write_file

from torchrl_bmrl.data.episodes import RESERVED, Episode, LazyEpisodes
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.data.schema import (
    Summary,
    arrays_of,
    check_episode,
    find_problems,
    is_continuous,
    layout_of,
    summarise,
)
from torchrl_bmrl.errors import DataError

STEPS = 5
GROUPS = {"obs": "observations", "next_obs": "next_observations"}


def with_array(episode: Episode, key: str, array: Any) -> Episode:
    """The same episode with another array under a key of robomimic's layout."""
    group, _, name = key.rpartition("/")
    if group in GROUPS:
        parts = {**getattr(episode, GROUPS[group]), name: array}
        return replace(episode, **{GROUPS[group]: parts})
    if key in episode.extras:
        return replace(episode, extras={**episode.extras, key: array})
    return replace(episode, **{key: array})


def changed(key: str, row: int, value: Any) -> Episode:
    array = arrays_of(make_episode())[key].copy()
    array.reshape(len(array), -1)[row, -1] = value
    return with_array(make_episode(), key, array)


def problems(episode: Episode, **options: Any) -> dict[str, str]:
    return dict(find_problems(episode, **options))


KEYS = list(arrays_of(make_episode()))
FLOATS = [key for key in KEYS if arrays_of(make_episode())[key].dtype.kind == "f"]
ACTIONS = make_episode().actions
FLAGS = ["terminated", "successes"]


# -- one episode -----------------------------------------------------------------------------------


def test_a_whole_episode_has_no_problem() -> None:
    for episode in (make_episode(), make_episode(terminated=True), make_episode(steps=1)):
        assert problems(episode, layout=layout_of(episode)) == {}


def test_actions_and_rewards_may_be_whole_numbers_of_any_size() -> None:
    episode = replace(make_episode(), actions=np.arange(STEPS), rewards=np.arange(STEPS))
    assert problems(episode) == {}
    assert problems(replace(episode, terminated=np.zeros(STEPS, np.uint8))) == {}


def test_the_size_of_an_action_is_free() -> None:
    for shape in ((STEPS,), (STEPS, 3), (STEPS, 2, 2)):
        assert problems(replace(make_episode(), actions=np.zeros(shape))) == {}


def test_an_episode_has_at_least_one_step() -> None:
    empty = {key: array[:0] for key, array in arrays_of(make_episode()).items()}
    episode = make_episode()
    for key, array in empty.items():
        episode = with_array(episode, key, array)
    assert list(problems(episode)) == ["actions"]
    assert "at least one step" in problems(episode)["actions"]


def test_an_episode_has_at_least_one_part_to_observe() -> None:
    episode = replace(make_episode(), observations={}, next_observations={})
    assert problems(episode) == {"obs": "no part of an observation; valid: at least one"}


@pytest.mark.parametrize("rows", [0, STEPS - 1, STEPS + 1])
@pytest.mark.parametrize("key", KEYS)
def test_the_array_whose_rows_differ_from_the_others_is_at_fault(key: str, rows: int) -> None:
    array = arrays_of(make_episode())[key]
    array = np.resize(array, (rows, *array.shape[1:]))
    found = problems(with_array(make_episode(), key, array))
    assert list(found) == [key]
    assert f"shape ({rows}," in found[key]
    assert f"valid: ({STEPS}," in found[key]


@pytest.mark.parametrize("key", KEYS)
def test_an_array_is_no_scalar(key: str) -> None:
    found = problems(with_array(make_episode(), key, np.asarray(0.0)))
    assert "shape ()" in found[key]


@pytest.mark.parametrize("key", ["rewards", *FLAGS])
def test_rewards_and_flags_are_one_number_a_step(key: str) -> None:
    column = arrays_of(make_episode())[key][:, None]
    found = problems(with_array(make_episode(), key, column))
    assert found == {key: f"shape ({STEPS}, 1); valid: ({STEPS},)"}


@pytest.mark.parametrize("dtype", [object, "U3", "S3", "datetime64[s]", complex, "V4"])
@pytest.mark.parametrize("key", KEYS)
def test_every_array_holds_numbers(key: str, dtype: Any) -> None:
    zeros = np.zeros_like(arrays_of(make_episode())[key], dtype=int)
    found = problems(with_array(make_episode(), key, zeros.astype(dtype)))
    assert found == {key: f"dtype {zeros.astype(dtype).dtype}; valid: numbers"}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", FLOATS)
def test_every_number_is_finite(key: str, value: float) -> None:
    found = problems(changed(key, 2, value))
    assert found == {key: "a value that is not finite in row 2"}


@pytest.mark.parametrize("value", [1.5, -1.5, 1.001, -1.00001])
def test_actions_lie_in_their_bounds(value: float) -> None:
    episode = changed("actions", 3, value)
    found = problems(episode)
    assert list(found) == ["actions"]
    assert f"{np.float32(value)}"[:5] in found["actions"]
    assert "in row 3 is outside [-1.0, 1.0]" in found["actions"]
    assert problems(episode, bounds=(-2, 2)) == problems(episode, bounds=None) == {}


@pytest.mark.parametrize("value", [1.0, -1.0, 1 + 1e-7])
def test_actions_may_be_at_their_bounds(value: float) -> None:
    episode = with_array(make_episode(), "actions", np.full((STEPS, 7), value))
    assert problems(episode) == {}


def test_bounds_may_be_lopsided() -> None:
    episode = with_array(make_episode(), "actions", np.full((STEPS, 7), 0.5))
    assert problems(episode, bounds=(0, 1)) == {}
    assert "outside [0, 0.4]" in problems(episode, bounds=(0, 0.4))["actions"]
    assert "outside [0.6, 1]" in problems(episode, bounds=(0.6, 1))["actions"]


@pytest.mark.parametrize("value", [2, -1])
@pytest.mark.parametrize("key", FLAGS)
def test_flags_are_0_or_1(key: str, value: int) -> None:
    flags = np.zeros(STEPS, dtype=int)
    assert problems(with_array(make_episode(), key, flags)) == {}
    flags[2] = value
    found = problems(with_array(make_episode(), key, flags))
    assert found == {key: f"{value} in row 2; valid: 0 or 1"}


def test_an_episode_ends_where_it_terminates() -> None:
    found = problems(replace(make_episode(), terminated=np.arange(STEPS) == 1))
    assert found == {"terminated": f"terminated in row 1 of {STEPS}, but the episode goes on"}


def test_a_part_has_its_next() -> None:
    episode = make_episode()
    after = {"object": episode.next_observations["object"]}
    assert problems(replace(episode, next_observations=after)) == {"next_obs/image": "missing"}


@pytest.mark.parametrize("array", [np.zeros((STEPS, 9)), np.zeros((STEPS, 10), np.float32)])
def test_a_part_and_its_next_are_alike(array: np.ndarray) -> None:
    found = problems(with_array(make_episode(), "next_obs/object", array))
    assert list(found) == ["next_obs/object"]
    assert f"{array.dtype} of shape {array.shape} where obs has float64" in found["next_obs/object"]


@pytest.mark.parametrize("name", sorted(RESERVED))
def test_names_of_torchrl_s_layout_are_taken(name: str) -> None:
    parts = {name: ((2,), np.float64)}
    found = problems(make_episode(parts=parts))
    assert list(found) == [f"obs/{name}"]
    assert "valid: none of" in found[f"obs/{name}"]


@pytest.mark.parametrize("name", [".hidden", "a\\b", "n" * 300])
def test_names_that_no_file_of_a_memory_map_can_have_are_refused(name: str) -> None:
    found = problems(make_episode(parts={name: ((2,), np.float64)}))
    assert list(found) == [f"obs/{name}"]
    assert "without slashes" in found[f"obs/{name}"]


LAYOUT = layout_of(make_episode())


@pytest.mark.parametrize("key", [key for key in LAYOUT if "/" not in key])
def test_episodes_have_equal_dtypes(key: str) -> None:
    array = arrays_of(make_episode())[key].astype(np.int16 if key in FLAGS else np.float16)
    found = problems(with_array(make_episode(), key, array), layout=LAYOUT)
    assert found == {key: f"dtype {array.dtype}; others have {LAYOUT[key][1]}"}


def test_episodes_have_equal_shapes() -> None:
    array = make_episode().actions[:, :-1]
    found = problems(with_array(make_episode(), "actions", array), layout=LAYOUT)
    message = f"shape ({STEPS}, 6); valid: ({STEPS}, 7), as in the other episodes"
    assert found == {"actions": message}


def test_states_of_other_models_are_no_fault() -> None:
    array = make_episode().extras["states"][:, :-1]
    assert problems(with_array(make_episode(), "states", array), layout=LAYOUT) == {}


def test_parts_have_equal_shapes_in_all_episodes() -> None:
    other = make_episode(parts={**PARTS, "object": ((9,), np.float64)})
    assert list(problems(other, layout=LAYOUT)) == ["obs/object", "next_obs/object"]
    assert problems(other) == {}


def test_episodes_have_equal_arrays() -> None:
    more = make_episode(parts={**PARTS, "force": ((3,), np.float64)})
    less = make_episode(parts={"object": PARTS["object"]})
    found = problems(more, layout=LAYOUT)
    assert found == dict.fromkeys(["obs/force", "next_obs/force"], "other episodes do not have it")
    found = problems(less, layout=LAYOUT)
    message = "missing, but other episodes have it"
    assert found == dict.fromkeys(["next_obs/image", "obs/image"], message)
    silent = {key: extra for key, extra in make_episode().extras.items() if key != "successes"}
    found = problems(replace(make_episode(), extras=silent), layout=LAYOUT)
    assert found == {"successes": message}


def test_every_problem_of_an_episode_is_found() -> None:
    episode = changed("rewards", 1, np.nan)
    episode = with_array(episode, "obs/object", np.zeros((STEPS, 10), "S3"))
    episode = with_array(episode, "actions", np.full((STEPS, 7), 2.0))
    episode = replace(episode, terminated=np.ones(STEPS, bool))
    expected = {"rewards", "obs/object", "actions", "terminated"}
    assert set(problems(episode)) == expected


def test_the_check_names_file_episode_key_and_how_much_more_is_wrong() -> None:
    check_episode("a.hdf5", "data/demo_0", make_episode())
    episode = changed("rewards", 1, np.nan)
    with pytest.raises(DataError) as caught:
        check_episode("a.hdf5", "data/demo_0", episode)
    assert caught.value.key == "data/demo_0/rewards"
    expected = "a.hdf5: data/demo_0/rewards: a value that is not finite in row 1"
    assert str(caught.value) == expected
    episode = replace(episode, actions=np.full((STEPS, 7), 2.0), terminated=np.ones(STEPS, bool))
    with pytest.raises(DataError, match=r"row 1 \(2 more: `python -m torchrl_bmrl\.data check`"):
        check_episode("a.hdf5", "data/demo_0", episode)


def test_the_check_passes_layout_and_bounds_on() -> None:
    episode = with_array(make_episode(), "actions", np.full((STEPS, 6), 2.0))
    check_episode("a.hdf5", "data/demo_0", episode, bounds=None)
    with pytest.raises(DataError, match="outside"):
        check_episode("a.hdf5", "data/demo_0", episode)
    with pytest.raises(DataError, match="as in the other episodes"):
        check_episode("a.hdf5", "data/demo_0", episode, bounds=None, layout=LAYOUT)


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
    bad = with_array(changed("rewards", 1, np.nan), "actions", np.full_like(ACTIONS, 2))
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
    expected = "actions: dimension 6 is at ±1 in 60% of all steps"
    assert warnings_of([saturate(e, 6) for e in episodes]) == [expected]


def test_discrete_actions_do_not_saturate() -> None:
    assert warnings_of([replace(e, actions=np.arange(len(e)).clip(0, 1)) for e in varied()]) == []


def test_the_same_episode_twice_deserves_a_look() -> None:
    episodes = [*varied(), make_episode(1, STEPS + 1)]
    assert warnings_of(episodes) == ["the same episode 2 times: demo_1, demo_3"]
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
    expected = "actions: outside [-1, 1]; tell the loss its bounds"
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
