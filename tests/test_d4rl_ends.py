"""Episodes of D4RL's flat files end where the file or the horizon states it, never by a guess."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("h5py")

from d4rl_files import ENDS, NAMES, N, find_oddities, joined, make_arrays, read, write

from torchrl_bmrl.data import d4rl_layout
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import complete
from torchrl_bmrl.errors import ConfigError, DataError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "hopper.hdf5"


def test_a_whole_last_episode_is_no_oddity(path: Path) -> None:
    arrays = make_arrays()
    arrays["timeouts"][-1] = True
    write(path, arrays)
    assert list(read(path)) == NAMES
    assert find_oddities(path) == []


def test_without_next_observations_what_is_left_out_is_accounted_for(path: Path) -> None:
    arrays = make_arrays()
    episodes = read(write(path, arrays, next_observations=None))
    assert all(raw.next_observations is None for raw in episodes.values())
    whole = [complete(path, name, raw, ReadOptions()) for name, raw in episodes.items()]
    # The episode that terminates keeps its last step, since no observation follows.
    assert [len(episode) for episode in whole] == [4, 5, 5, 2]
    assert [episode.left_out.steps for episode in whole] == [0, 1, 1, 1]
    assert [episode.left_out.reward for episode in whole] == [0, 1, 1, 1]
    assert sum(len(e) + e.left_out.steps for e in whole) == N
    assert sum(e.rewards.sum() + e.left_out.reward for e in whole) == arrays["rewards"].sum()
    for episode, first in zip(whole, (0, 4, 10, 16), strict=True):
        rows = slice(first + 1, first + len(episode))
        assert_array_equal(
            episode.next_observations["observation"][: len(episode) - 1],
            arrays["observations"][rows],
        )
    # No next observation comes from the episode that follows.
    for name, raw in episodes.items():
        kept = complete(path, name, raw, ReadOptions(last_step="truncate"))
        last = kept.next_observations["observation"][-1]
        assert_array_equal(last, raw.observations["observation"][-1])


def test_without_timeouts_jumps_of_the_observations_are_ends(path: Path) -> None:
    arrays = make_arrays()
    episodes = read(write(path, arrays, timeouts=None))
    assert list(episodes) == NAMES
    assert_array_equal(joined(episodes, "terminated"), arrays["terminals"])
    assert find_oddities(path) == [
        "no timeouts: an episode ends at a terminal and where the next observation is not the next "
        "row's",
        "rows 16 to 18 end in neither a terminal nor a timeout: read as an episode that was cut",
    ]


@pytest.mark.parametrize("block", [1, 12, 60, 2**24])
def test_jumps_are_found_in_blocks_of_any_size(
    path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(d4rl_layout, "BLOCK", block)
    assert list(read(write(path, make_arrays(), timeouts=None))) == NAMES


def test_ends_that_nothing_tells_are_refused_with_the_ways_out(path: Path) -> None:
    write(path, make_arrays(), timeouts=None, next_observations=None)
    message = (
        "timeouts: missing, and so is next_observations: it is unknown where episodes were cut; "
        r"valid: timeouts \(N,\), or a horizon, the longest episode's steps"
    )
    with pytest.raises(DataError, match=message):
        read(path)
    with pytest.raises(DataError, match=message):
        find_oddities(path)


def test_next_observations_made_by_shifting_do_not_tell_ends(path: Path) -> None:
    arrays = make_arrays()
    shifted = np.roll(arrays["observations"], -1, axis=0)
    write(path, arrays, timeouts=None, next_observations=shifted)
    with pytest.raises(DataError, match=r"next_observations: row 3 is the next row's .*shifting"):
        read(path)
    # Without a terminal inside, shifting cannot be detected.
    write(path, arrays, timeouts=None, next_observations=shifted, terminals=np.zeros(N))
    assert list(read(path)) == ["rows_0_to_18"]
    assert "all 19 rows are one episode" in find_oddities(path)[1]


def test_timeouts_whose_next_observation_is_the_next_episodes_are_said(path: Path) -> None:
    arrays = make_arrays()
    write(path, arrays, next_observations=np.roll(arrays["observations"], -1, axis=0))
    assert find_oddities(path)[1:] == [
        "at 2 of 2 timeouts, such as row 9, next_observations is the next episode's first "
        "observation: values bootstrapped from there are wrong, unless the episode went on; "
        "without next_observations these steps are left out"
    ]
    assert list(read(path)) == NAMES
    # No value is bootstrapped after a terminal.
    arrays["terminals"][9] = True
    write(path, arrays, next_observations=np.roll(arrays["observations"], -1, axis=0))
    assert find_oddities(path)[2].startswith("at 1 of 1 timeouts, such as row 15, ")


def test_a_row_that_is_terminal_and_timeout_terminates_and_is_said(path: Path) -> None:
    arrays = make_arrays()
    arrays["terminals"][9] = True
    episodes = read(write(path, arrays))
    assert joined(episodes, "terminated")[list(ENDS)].tolist() == [True, True, False, False]
    assert find_oddities(path)[1:] == [
        "1 rows are terminal and timeout at once, such as 9: read as terminal"
    ]


# -- a horizon -------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [("next_observations", "timeouts"), ("timeouts",)])
def test_a_horizon_cuts_as_d4rl_does(path: Path, parts: tuple[str, ...]) -> None:
    arrays = make_arrays()
    write(path, {key: x for key, x in arrays.items() if key not in parts})
    assert list(read(path, horizon=6)) == NAMES
    assert find_oddities(path, horizon=6) == [
        "rows 16 to 18 end in neither a terminal nor a timeout: read as an episode that was cut"
    ]
    assert list(read(path, horizon=5)) == [
        *("rows_0_to_3", "rows_4_to_8", "rows_9_to_13", "rows_14_to_18")
    ]
    assert find_oddities(path, horizon=5) == []
    # Only terminals end episodes.
    assert list(read(path, horizon=N)) == ["rows_0_to_3", "rows_4_to_18"]


def d4rl_ends(terminals: np.ndarray, horizon: int) -> list[int]:
    """Ends as d4rl.sequence_dataset counts them, with env._max_episode_steps."""
    ends, step = [], 0
    for row, terminal in enumerate(terminals):
        final = step == horizon - 1
        step += 1
        if terminal or final:
            ends.append(row)
            step = 0
    return ends


@pytest.mark.parametrize("seed", range(20))
def test_a_horizon_cuts_where_d4rls_loop_does(path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    horizon = int(rng.integers(1, 9))
    terminals = rng.random(N) < 0.2
    write(path, make_arrays(), terminals=terminals, timeouts=None)
    ends = [int(name.split("_")[-1]) for name in read(path, horizon=horizon)]
    assert sorted({*d4rl_ends(terminals, horizon), N - 1}) == ends


@pytest.mark.parametrize("horizon", [0, -1, 2.5, True, "6"])
def test_a_horizon_is_a_number_of_steps(path: Path, horizon: Any) -> None:
    write(path, make_arrays(), timeouts=None)
    with pytest.raises(ConfigError, match=r"horizon is .*; valid: 1 and more, None"):
        read(path, horizon=horizon)


def test_a_horizon_beside_timeouts_is_refused(path: Path) -> None:
    with pytest.raises(ConfigError, match=r"horizon is 6, but .* has timeouts; valid: None"):
        read(write(path, make_arrays()), horizon=6)
