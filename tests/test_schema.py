"""What keeps data from being trained on, all of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

from episode_files import PARTS, changed, make_episode, with_array

from torchrl_bmrl.data.episodes import RESERVED, Episode
from torchrl_bmrl.data.schema import (
    arrays_of,
    check_episode,
    find_problems,
    layout_of,
)
from torchrl_bmrl.errors import DataError

STEPS = 5


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


@pytest.mark.parametrize("key", ["obs/object", "next_obs/object"])
def test_observations_beyond_float32_are_refused_with_their_row(key: str) -> None:
    said = problems(changed(key, 3, -1e300))
    assert said == {key: "-1e+300 in row 3; valid: at most 3.4e+38, as in float32"}
    assert problems(changed(key, 3, 3e38)) == {}


def test_an_episode_has_at_least_one_step() -> None:
    empty = {key: array[:0] for key, array in arrays_of(make_episode()).items()}
    episode = make_episode()
    for key, array in empty.items():
        episode = with_array(episode, key, array)
    assert list(problems(episode)) == ["actions"]
    assert "at least one step" in problems(episode)["actions"]


def test_an_episode_has_at_least_one_part_to_observe() -> None:
    episode = replace(make_episode(), observations={}, next_observations={})
    assert problems(episode) == {"obs": "no part of the observation; valid: at least one"}


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
