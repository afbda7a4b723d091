"""A last step without a next observation is kept as asked, or counted; no reward is lost unseen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")

from file_edits import put
from tool_files import EPISODES, LAST, STEPS, checked, load, write
from torchrl.data.datasets import load_dataset

from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.convert import convert
from torchrl_bmrl.errors import DataError


def test_a_file_that_would_lose_all_of_its_reward_is_refused_by_every_command(
    tmp_path: Path, capsys: Any
) -> None:
    path = write(tmp_path / "a.hdf5")
    code, out, err = checked(path, capsys)
    assert code == 1
    assert "in the file       4 episodes, 80 steps, reward 4, 0 successes" in out
    assert "read              4 episodes, 76 steps, reward 0, 0 successes" in out
    assert "left out          4 steps, reward 4, 0 successes" in out
    says = "all of the reward (4) is in last steps and would be lost"
    assert f"{path}: rewards: {says}" in err
    with pytest.raises(DataError, match="last_step 'truncate' or 'terminate'"):
        load(path)
    with pytest.raises(DataError) as caught:
        convert(path, tmp_path / "b.hdf5", to="robomimic")
    assert says in str(caught.value)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.hdf5"]


@pytest.mark.parametrize(
    ("options", "flags", "terminated"),
    [
        ({"last_step": "truncate"}, ["--last-step", "truncate"], 0),
        ({"last_step": "terminate"}, ["--last-step", "terminate"], EPISODES),
        ({"dones_terminate": True}, ["--dones-terminate"], EPISODES),
    ],
)
def test_each_way_out_keeps_every_step_in_every_command(
    tmp_path: Path, capsys: Any, options: Any, flags: list[str], terminated: int
) -> None:
    path = write(tmp_path / "a.hdf5")
    data = load(path, **options)[:]
    assert len(data) == EPISODES * STEPS
    assert data["next", "reward"].sum() == EPISODES
    assert data["next", "terminated"].sum() == terminated
    last = data["next", "done"].squeeze(-1)
    assert (data["next", "x"][last] == data["x"][last]).all()
    code, out, _ = checked(path, capsys, *flags)
    assert code == 0
    assert "left out          nothing" in out
    assert f"{EPISODES - terminated} truncated, {terminated} terminated" in out
    assert main(["convert", str(path), str(tmp_path / "b.hdf5"), "--to", "robomimic", *flags]) == 0
    again = load(tmp_path / "b.hdf5")[:]
    for key in data.keys(include_nested=True, leaves_only=True):
        assert (data[key] == again[key]).all(), key


def test_what_is_left_out_on_request_is_said_and_not_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5")
    with pytest.warns(UserWarning, match="4 last steps with a reward of 4 of 4 and 0 of 0 succ"):
        replay = load_dataset(f"robomimic:{path}", last_step="drop")
    assert len(replay) == EPISODES * (STEPS - 1)
    assert replay.metadata["account"]["cut"] == {"steps": 4, "reward": 4.0, "successes": 0}
    # The warning comes again where the converted copy exists already.
    with pytest.warns(UserWarning, match="4 last steps"):
        load_dataset(f"robomimic:{path}", last_step="drop")


def test_a_dense_reward_is_loaded_with_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", put("rewards", np.full(STEPS, 0.5)))
    with pytest.warns(UserWarning, match="with a reward of 2 of 40"):
        data = load_dataset(f"robomimic:{path}")[:]
    assert data["next", "reward"].sum() == 38


def test_successes_that_are_all_at_last_steps_are_not_lost_in_silence(tmp_path: Path) -> None:
    dense = put("rewards", np.full(STEPS, 0.5))
    path = write(tmp_path / "a.hdf5", dense, put("successes", LAST))
    with pytest.raises(DataError, match=r"successes: all successes \(4\) are in last steps"):
        load(path)
    assert load(path, last_step="truncate")[:]["next", "success"].sum() == EPISODES


def test_one_more_observation_than_actions_is_the_last_next_observation(tmp_path: Path) -> None:
    x = np.random.default_rng(1).standard_normal((STEPS + 1, 3))
    data = load(write(tmp_path / "a.hdf5", put("obs/x", x)))[:]
    assert len(data) == EPISODES * STEPS
    assert data["next", "reward"].sum() == EPISODES
    np.testing.assert_array_equal(data["next", "x"][STEPS - 1], x[-1])
    np.testing.assert_array_equal(data["x"][STEPS - 1], x[-2])


def test_an_episode_of_one_step_without_a_next_observation_needs_a_decision(tmp_path: Path) -> None:
    def shorten(demo: Any) -> None:
        if demo.name.endswith("2"):
            for key in ("obs/x", "actions", "rewards", "dones"):
                put(key, demo[key][-1:])(demo)

    path = write(tmp_path / "a.hdf5", shorten)
    with pytest.raises(DataError, match="data/demo_2: a single step, and no observation after it"):
        load(path, last_step="drop")
    assert len(load(path, last_step="terminate")) == 3 * STEPS + 1


# -- faults in the step that is left out -----------------------------------------------------------


def test_a_number_that_is_not_finite_is_found_in_a_step_that_is_left_out(tmp_path: Path) -> None:
    rewards = np.ones(STEPS)
    rewards[-1] = np.nan
    path = write(tmp_path / "a.hdf5", put("rewards", rewards))
    with pytest.raises(DataError, match=f"rewards: a value that is not finite in row {STEPS - 1}"):
        load(path)


@pytest.mark.parametrize("value", [7, np.nan])
def test_a_success_that_is_neither_0_nor_1_is_found_in_a_step_that_is_left_out(
    tmp_path: Path, value: float
) -> None:
    path = write(tmp_path / "a.hdf5", put("successes", np.where(LAST, value, 1.0)))
    with pytest.raises(DataError, match=f"demo_0/successes: .* in row {STEPS - 1}; valid: 0 or 1"):
        load(path, last_step="drop")


def test_a_last_observation_that_is_not_finite_is_named_as_the_file_has_it(tmp_path: Path) -> None:
    observations = np.zeros((STEPS + 1, 3))
    observations[-1] = np.nan
    path = write(tmp_path / "a.hdf5", put("obs/x", observations))
    with pytest.raises(DataError, match=f"demo_0/obs/x: .* not finite in row {STEPS}"):
        load(path)


# -- lengths and shapes ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "array"),
    [
        ("rewards", np.zeros(STEPS - 1)),
        ("actions", np.zeros((STEPS - 1, 7))),
        ("actions", np.zeros((STEPS + 1, 7))),
        ("obs/x", np.zeros((STEPS - 1, 3))),
        ("obs/x", np.zeros((STEPS + 2, 3))),
        ("terminated", np.zeros(STEPS + 1)),
        ("successes", np.zeros(STEPS - 2)),
    ],
    ids=lambda value: value if isinstance(value, str) else str(len(value)),
)
def test_the_array_of_another_length_is_named_with_the_length_that_it_has_in_the_file(
    tmp_path: Path, key: str, array: np.ndarray
) -> None:
    path = write(tmp_path / "a.hdf5", put(key, array))
    for options in ({}, {"last_step": "truncate"}, {"dones_terminate": True}):
        with pytest.raises(DataError) as caught:
            load(path, **options)
        assert caught.value.key == f"data/demo_0/{key}"
        assert f"shape {array.shape}; valid: " in caught.value.message


def test_an_episode_without_steps_is_named(tmp_path: Path, capsys: Any) -> None:
    def empty(demo: Any) -> None:
        for key in ("obs/x", "actions", "rewards", "dones"):
            put(key, demo[key][:0])(demo)

    code, _, err = checked(write(tmp_path / "a.hdf5", empty), capsys)
    assert code == 1
    assert "data/demo_0/actions: shape (0, 7)" in err


@pytest.mark.parametrize("key", ["rewards", "dones", "terminated", "successes"])
@pytest.mark.parametrize("next_obs", [True, False])
def test_one_number_a_step_may_be_a_column(tmp_path: Path, key: str, next_obs: bool) -> None:
    flat = write(tmp_path / "a.hdf5", put(key, 1.0 * LAST), next_obs=next_obs)
    column = write(tmp_path / "b.hdf5", put(key, 1.0 * LAST[:, None]), next_obs=next_obs)
    options = {"dones_terminate": True, "last_step": "truncate"}
    assert (load(flat, **options)[:] == load(column, **options)[:]).all()


@pytest.mark.parametrize("key", ["rewards", "dones", "terminated", "successes"])
def test_two_numbers_a_step_are_named_with_the_shape_that_the_file_has(
    tmp_path: Path, capsys: Any, key: str
) -> None:
    path = write(tmp_path / "a.hdf5", put(key, np.zeros((STEPS, 2))))
    code, _, err = checked(path, capsys, "--dones-terminate")
    assert code == 1
    assert f"data/demo_0/{key}: shape ({STEPS}, 2); valid: ({STEPS},)" in err
    with pytest.raises(DataError, match=rf"demo_0/{key}: shape \({STEPS}, 2\)"):
        load(path, dones_terminate=True)
