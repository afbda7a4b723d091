"""Actions lie in the space that a data set of Minari's states, and so do their bounds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("minari")

import gymnasium.spaces as gym
import minari
from episode_files import assert_identical
from minari_files import (
    BOXES,
    ID,
    data_set,
    make_buffer,
    minari_episodes,
    read,
    read_metadata,
    write_with_minari,
)

from torchrl_bmrl.data.minari import write_episodes
from torchrl_bmrl.errors import ConfigError, DataError

# Minari warns of data sets that name no author, environment or code.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


def write_actions(space: gym.Space, actions: np.ndarray) -> None:
    write_with_minari(BOXES[0], space, make_buffer(3, actions=actions))


@pytest.mark.parametrize(
    ("space", "actions", "message"),
    [
        (gym.Discrete(3), np.array([0, 3, 1]), r"actions: 3 in row 1 is outside \[0, 2\], its"),
        (gym.Discrete(3, start=1), np.array([1, 3, 0]), r"0 in row 2 is outside \[1, 3\]"),
        (gym.Discrete(3), np.zeros(3), "actions: dtype float64; valid: int64, as metadata.json"),
        (gym.Discrete(3), np.zeros((3, 1), int), r"shape \(3, 1\); valid: \(T\)"),
        (gym.MultiDiscrete([2, 3]), np.array([[1, 2], [2, 0], [0, 0]]), r"2 in row 1 .*\[0, 1\]"),
        (gym.MultiBinary(2), np.full((3, 2), 2, np.int8), r"2 in row 0 is outside \[0, 1\]"),
        (
            gym.Box(np.array([-np.inf, 0]), np.array([np.inf, 1]), dtype=np.float64),
            np.array([[5, 0.5], [5, 1.5], [0, 0]]),
            r"1.5 in row 1 is outside \[0.0, 1.0\]",
        ),
        (gym.Box(-3, 3, (2,), int), np.full((3, 2), 4), r"4 in row 0 is outside \[-3, 3\]"),
    ],
    ids=["n", "start", "floats", "a column", "several", "binary", "half a box", "integers"],
)
def test_actions_that_are_not_of_their_space_are_refused(
    minari_root: Path, space: gym.Space, actions: np.ndarray, message: str
) -> None:
    write_actions(space, actions)
    with pytest.raises(DataError, match=message):
        read(minari_root / ID)


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (gym.Discrete(3), np.array([0, 2, 1])),
        (gym.MultiDiscrete([2, 3]), np.array([[1, 2], [0, 0], [1, 1]])),
        (gym.MultiBinary(2), np.ones((3, 2), np.int8)),
    ],
    ids=["discrete", "several", "binary"],
)
def test_actions_of_any_space_come_back_and_state_no_bounds(
    minari_root: Path, space: gym.Space, actions: np.ndarray
) -> None:
    write_actions(space, actions)
    (episode,) = read(minari_root / ID)
    assert_identical(episode.actions, actions)
    assert "action_bounds" not in read_metadata(minari_root / ID)


def test_matrices_state_one_range_or_none(minari_root: Path) -> None:
    write_actions(gym.Box(-3, 3, (2, 2)), np.full((3, 2, 2), 3, np.float32))
    assert read_metadata(minari_root / ID)["action_bounds"] == {"low": -3.0, "high": 3.0}


@pytest.mark.parametrize(
    ("low", "high", "stated"),
    [
        (-2, 2, {"low": -2.0, "high": 2.0}),
        ([-2, -1], [2, 0.5], {"low": [-2.0, -1.0], "high": [2.0, 0.5]}),
        ([-2, -1], 3, {"low": [-2.0, -1.0], "high": 3.0}),
        (-np.inf, 2, None),
        ([-1, -1], [1, np.inf], None),
        (-float(np.finfo(np.float32).max), float(np.finfo(np.float32).max), None),
        (-1, [1, -1], None),  # one action alone
    ],
)
def test_a_finite_box_states_the_bounds_of_actions(
    minari_root: Path, low: Any, high: Any, stated: dict[str, Any] | None
) -> None:
    ends = [np.broadcast_to(np.float32(end), 2) for end in (low, high)]
    write_actions(gym.Box(*ends, dtype=np.float32), np.full((3, 2), -1, np.float32))
    assert read_metadata(minari_root / ID).get("action_bounds") == stated


def test_bounds_are_written_as_the_space_and_read_again(minari_root: Path) -> None:
    bounds = ([-2.0] * 7, [3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    write_episodes(minari_root / ID, minari_episodes(), bounds=bounds)
    space = minari.load_dataset(ID).action_space
    assert space == gym.Box(np.float32(bounds[0]), np.float32(bounds[1]), dtype=np.float32)
    assert read_metadata(minari_root / ID)["action_bounds"] == {"low": -2.0, "high": bounds[1]}


def test_without_bounds_the_space_has_none(minari_root: Path) -> None:
    path = data_set(minari_root)
    assert not minari.load_dataset(ID).action_space.is_bounded()
    assert "action_bounds" not in read_metadata(path)


def test_bounds_that_do_not_fit_are_refused(minari_root: Path) -> None:
    with pytest.raises(DataError, match=r"episode_0/actions: .* is outside \[-0.1, 0.1\]"):
        write_episodes(minari_root / ID, minari_episodes(), bounds=(-0.1, 0.1))
    with pytest.raises(ConfigError, match=r"bounds is .*; valid: two finite numbers"):
        write_episodes(minari_root / ID, minari_episodes(), bounds=(1, -1))
    with pytest.raises(DataError, match=r"episode_0/actions: shape \(5, 7\); valid: \(T, 2\)"):
        write_episodes(minari_root / ID, minari_episodes(), bounds=([-1, -1], 1))
    assert list((minari_root / "sawyer").iterdir()) == []
