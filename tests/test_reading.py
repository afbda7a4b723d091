"""What files lack and what is read all the same, with every step, reward and success accounted."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py
from torchrl.data.datasets import load_dataset

import torchrl_bmrl.data  # noqa: F401  registers the prefix
from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.convert import convert, open_source
from torchrl_bmrl.data.robomimic import read_metadata
from torchrl_bmrl.errors import ConfigError, DataError

EPISODES, STEPS = 4, 20
Edit = Callable[[Any], object]


def write(path: Path, *edits: Edit, next_obs: bool = False) -> Path:
    """Another tool's file: reward 1 and done 1 at each last step."""
    rng = np.random.default_rng(0)
    last = np.arange(STEPS) == STEPS - 1
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = "{}"
        for i in range(EPISODES):
            demo, x = file.create_group(f"data/demo_{i}"), rng.standard_normal((STEPS + 1, 3))
            demo["obs/x"] = x[:-1]
            demo["actions"] = rng.uniform(-1, 1, (STEPS, 7))
            demo["rewards"], demo["dones"] = 1.0 * last, 1 * last
            if next_obs:
                demo["next_obs/x"] = x[1:]
            for edit in edits:
                edit(demo)
    return path


def put(key: str, value: Any) -> Edit:
    """Replaces an array of an episode."""

    def edit(demo: Any) -> None:
        if key in demo:
            del demo[key]
        demo[key] = value

    return edit


def tell(name: str, value: Any) -> Edit:
    """Gives an episode an attribute; a function gets its number."""

    def edit(demo: Any) -> None:
        number = int(demo.name.split("_")[-1])
        demo.attrs[name] = value(number) if callable(value) else value

    return edit


def load(path: Path, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_dataset(f"robomimic:{path}", **options)


def checked(path: Path, capsys: Any, *options: str) -> tuple[int, str, str]:
    """Exit code and what `check` prints."""
    code = main(["check", str(path), *options])
    told = capsys.readouterr()
    return code, told.out, told.err


# -- the last step ---------------------------------------------------------------------------------


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
    # Of a copy that was made before, too.
    with pytest.warns(UserWarning, match="4 last steps"):
        load_dataset(f"robomimic:{path}", last_step="drop")


def test_a_dense_reward_is_loaded_with_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", put("rewards", np.full(STEPS, 0.5)))
    with pytest.warns(UserWarning, match="with a reward of 2 of 40"):
        data = load_dataset(f"robomimic:{path}")[:]
    assert data["next", "reward"].sum() == 38


def test_successes_that_are_all_at_last_steps_are_not_lost_in_silence(tmp_path: Path) -> None:
    last = np.arange(STEPS) == STEPS - 1
    dense = put("rewards", np.full(STEPS, 0.5))
    path = write(tmp_path / "a.hdf5", dense, put("successes", last))
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


def test_a_number_that_is_not_finite_is_found_in_a_step_that_is_left_out(tmp_path: Path) -> None:
    rewards = np.ones(STEPS)
    rewards[-1] = np.nan
    path = write(tmp_path / "a.hdf5", put("rewards", rewards))
    with pytest.raises(DataError, match=f"rewards: a value that is not finite in row {STEPS - 1}"):
        load(path)


def test_an_episode_of_one_step_without_a_next_observation_needs_a_decision(tmp_path: Path) -> None:
    def shorten(demo: Any) -> None:
        if demo.name.endswith("2"):
            for key in ("obs/x", "actions", "rewards", "dones"):
                put(key, demo[key][-1:])(demo)

    path = write(tmp_path / "a.hdf5", shorten)
    with pytest.raises(DataError, match="data/demo_2: a single step, and no observation after it"):
        load(path, last_step="drop")
    assert len(load(path, last_step="terminate")) == 3 * STEPS + 1


# -- rewards and successes -------------------------------------------------------------------------


def isaac(demo: Any) -> None:
    """As Isaac Lab's recorder writes: no rewards, an attribute, nested states, terms in a group."""
    del demo["rewards"], demo["dones"]
    demo.attrs["success"] = not demo.name.endswith("1")
    demo["initial_state/articulation/robot/joint_position"] = np.zeros((1, 9))
    demo["states/articulation/robot/joint_position"] = np.zeros((STEPS, 9))
    demo["obs/datagen_info/eef_pose"] = np.zeros((STEPS, 4, 4))
    demo["processed_actions"] = np.zeros((STEPS, 7))


def test_isaac_labs_files_get_their_reward_from_the_attribute_success(
    tmp_path: Path, capsys: Any
) -> None:
    path = write(tmp_path / "a.hdf5", isaac)
    with pytest.raises(DataError, match=r"demo_0/rewards: missing; .* 'success' or 'last'"):
        load(path)
    data = load(path, reward="success", last_step="terminate")[:]
    assert data["next", "reward"].squeeze(-1).nonzero().squeeze(-1).tolist() == [19, 59, 79]
    assert load(path, reward="last", last_step="terminate")[:]["next", "reward"].sum() == EPISODES
    flags = ["--reward", "success", "--last-step", "terminate"]
    code, out, _ = checked(path, capsys, *flags)
    assert code == 0
    assert "success           3 of 4; not in demo_1" in out
    for name in ("states", "initial_state", "obs/datagen_info"):
        assert f"{name} (4x)" in out
    assert main(["convert", str(path), str(tmp_path / "b.hdf5"), "--to", "robomimic", *flags]) == 0
    assert "not read in the episodes: obs/datagen_info (4x)" in capsys.readouterr().out


def test_failures_are_left_out_on_request_and_counted(tmp_path: Path, capsys: Any) -> None:
    path = write(tmp_path / "a.hdf5", tell("success", lambda i: i != 1), next_obs=True)
    replay = load(path, successful=True)
    assert len(replay) == 3 * STEPS
    assert replay.metadata["episodes"] == ["demo_0", "demo_2", "demo_3"]
    assert replay.metadata["account"]["failed"]["steps"] == STEPS
    code, out, _ = checked(path, capsys, "--successful")
    assert code == 0
    assert "in the file       4 episodes, 80 steps, reward 4, 3 successes" in out
    assert "left out          1 episodes, 20 steps, reward 1, 0 successes" in out
    done = convert(path, tmp_path / "b.hdf5", to="robomimic", successful=True)
    assert (done.account.read.steps, done.account.failed.steps) == (60, 20)
    assert any("renamed: 2 episodes, such as demo_2 to demo_1" in note for note in done.notes)


def test_successes_decide_before_the_attribute(tmp_path: Path) -> None:
    solved = np.arange(STEPS) > 10
    path = write(
        tmp_path / "a.hdf5", tell("success", False), put("successes", solved), next_obs=True
    )
    assert len(load(path, successful=True)) == EPISODES * STEPS
    rewards = load(path, reward="success")[:]["next", "reward"].reshape(EPISODES, STEPS)
    assert (rewards.numpy() == solved).all()


def test_success_that_nobody_tells_cannot_be_chosen_by(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    for option in ({"successful": True}, {"reward": "success"}):
        with pytest.raises(DataError, match="data/demo_0: no attribute success and no succ"):
            load(path, **option)
    path = write(tmp_path / "b.hdf5", tell("success", False), next_obs=True)
    with pytest.raises(DataError, match="none of 4 episodes succeeded"):
        load(path, successful=True)


# -- what is not for us ----------------------------------------------------------------------------


def test_what_other_tools_keep_stops_nothing_and_is_named(tmp_path: Path, capsys: Any) -> None:
    path = write(
        tmp_path / "a.hdf5",
        put("obs/datagen_info/pose", np.zeros(STEPS)),
        put("obs/language", ["lift the cube"] * STEPS),
        put("states/robot", np.zeros((STEPS, 9))),
        put("note", "a text"),
        put("next_obs/more", np.zeros((STEPS, 2))),
        next_obs=True,
    )
    with h5py.File(path, "a") as file:
        file["data/index"] = np.arange(4)
        file["data/config/seed"] = 1
        file["extra"] = 1
    data = load(path)[:]
    assert data["x"].shape == (EPISODES * STEPS, 3)
    assert data.exclude("next").keys() == {"x", "action", "episode", "step"}
    code, out, err = checked(path, capsys)
    assert (code, err) == (0, "")
    assert "beside the demonstrations, not read: data/config, data/index, extra" in out
    for name in ("obs/datagen_info", "obs/language", "states", "note", "next_obs/more"):
        assert f"{name} (4x)" in out, name


def test_a_part_that_is_a_group_in_some_episodes_alone_is_a_fault(tmp_path: Path) -> None:
    def damage(demo: Any) -> None:
        if demo.name.endswith("0"):
            del demo["obs/x"]
            demo["obs/x/y"] = 1.0

    with pytest.raises(DataError, match="data/demo_0/obs/x: a group"):
        load(write(tmp_path / "a.hdf5", damage, next_obs=True))


def test_attributes_that_contradict_the_arrays_are_said_and_not_believed(
    tmp_path: Path, capsys: Any
) -> None:
    path = write(tmp_path / "a.hdf5", tell("num_samples", STEPS - 1), next_obs=True)
    with h5py.File(path, "a") as file:
        file["data"].attrs["total"] = 3
    code, out, _ = checked(path, capsys)
    assert code == 0
    assert "num_samples contradicts the arrays in 4 episodes, such as demo_0 says 19 of 20" in out
    assert "total is 3 steps, but the arrays have 80" in out
    assert len(load(path)) == EPISODES * STEPS
    notes = convert(path, tmp_path / "b.hdf5", to="robomimic").notes
    assert any("num_samples" in note for note in notes)
    with h5py.File(tmp_path / "b.hdf5") as file:
        assert file["data"].attrs["total"] == EPISODES * STEPS


def test_observations_in_one_array_become_one_part(tmp_path: Path) -> None:
    x = np.random.default_rng(2).standard_normal((STEPS + 1, 5))

    def flatten(demo: Any) -> None:
        del demo["obs"], demo["next_obs"]
        demo["obs"], demo["next_obs"] = x[:-1], x[1:]

    path = write(tmp_path / "a.hdf5", flatten, next_obs=True)
    data = load(path)[:]
    np.testing.assert_array_equal(data["next", "observation"][:STEPS], x[1:])
    assert load(path, observation_keys=["observation"])[:]["observation"].shape == (80, 5)


# -- bounds of actions -----------------------------------------------------------------------------


def test_actions_beyond_1_go_in_with_their_bounds_through_every_command(
    tmp_path: Path, capsys: Any
) -> None:
    actions = np.random.default_rng(3).uniform(-2, 2, (STEPS, 7))
    path = write(tmp_path / "a.hdf5", put("actions", actions), next_obs=True)
    code, out, err = checked(path, capsys)
    assert code == 1
    assert "outside [-1.0, 1.0]; the option bounds sets others" in err
    (line,) = (line for line in out.splitlines() if line.split()[:1] == ["actions"])
    assert line.split()[-2:] == [f"{actions.min():.4g}", f"{actions.max():.4g}"]
    assert checked(path, capsys, "--bounds", "-2", "2")[0] == 0
    flags = ["--to", "robomimic", "--bounds", "-2", "2"]
    assert main(["convert", str(path), str(tmp_path / "b.hdf5"), *flags]) == 0
    assert read_metadata(tmp_path / "b.hdf5")["action_bounds"] == {"low": -2.0, "high": 2.0}
    replay = load(tmp_path / "b.hdf5")
    assert replay.metadata["action_bounds"] == {"low": -2.0, "high": 2.0}
    np.testing.assert_array_equal(replay[:]["action"][:STEPS], actions.astype(np.float32))
    assert checked(tmp_path / "b.hdf5", capsys)[0] == 0
    with pytest.raises(DataError, match=r"outside \[-1\.0, 1\.0\]"):
        load(tmp_path / "b.hdf5", bounds=(-1, 1))


def test_the_range_of_the_data_can_be_their_bounds(tmp_path: Path) -> None:
    actions = np.random.default_rng(3).uniform(-1, 1, (STEPS, 7)) * np.arange(7)
    path = write(tmp_path / "a.hdf5", put("actions", actions), next_obs=True)
    bounds = load(path, bounds="data").metadata["action_bounds"]
    np.testing.assert_allclose(bounds["low"][1:], actions.min(0)[1:])
    np.testing.assert_allclose(bounds["high"][1:], actions.max(0)[1:])
    assert (bounds["low"][0], bounds["high"][0]) == (-1, 1)  # constant: a range all the same


def test_bounds_of_another_size_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    with pytest.raises(DataError, match=r"actions: shape \(20, 7\); valid: \(T, 2\)"):
        load(path, bounds=([-1, -1], [1, 1]))
    assert len(load(path, bounds=([-1] * 7, 1))) == EPISODES * STEPS


@pytest.mark.parametrize(
    "options",
    [
        {"last_step": "keep"},
        {"reward": "sparse"},
        {"successful": 1},
        {"dones_terminate": "no"},
        {"bounds": (1, -1)},
        {"bounds": (0, np.inf)},
        {"bounds": 3},
        {"bounds": "range"},
        {"observation_keys": 5},
        {"reward": np.array(["last"])},
    ],
    ids=str,
)
def test_an_invalid_option_is_named_with_its_value_and_the_valid_ones(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    (name,) = options
    with pytest.raises(ConfigError, match=f"{name} is .*; valid: "):
        load(path, **options)
    with pytest.raises(ConfigError, match=f"{name} is .*; valid: "), open_source(path, **options):
        pass


# -- several files ---------------------------------------------------------------------------------


def test_files_become_one_without_losing_an_episode(tmp_path: Path, capsys: Any) -> None:
    paths = [write(tmp_path / f"{i}.hdf5", next_obs=True) for i in range(3)]
    for i, path in enumerate(paths[:2]):
        with h5py.File(path, "a") as file:
            file["mask/train"] = np.array([f"demo_{i}", "demo_3"], dtype="S")
            file["data"].attrs["author"] = f"author {i}"
    target = tmp_path / "all.hdf5"
    assert main(["convert", *map(str, paths), str(target), "--to", "robomimic"]) == 0
    told = capsys.readouterr().out
    assert f"{target}: robomimic, 12 episodes, 240 steps, reward 12, 0 successes" in told
    assert "left out, because the format has no place for it: author" in told
    data = load(target)[:]
    assert data["episode"].unique().tolist() == list(range(12))
    masks = read_metadata(target)["masks"]
    assert masks == {"train": ["demo_0", "demo_3", "demo_5", "demo_7"]}


def test_files_of_other_bounds_do_not_become_one(tmp_path: Path) -> None:
    one = write(tmp_path / "a.hdf5", next_obs=True)
    two = write(tmp_path / "b.hdf5", next_obs=True)
    with h5py.File(two, "a") as file:
        file["data"].attrs["action_bounds"] = json.dumps({"low": -2, "high": 2})
    with pytest.raises(ConfigError, match=r"b\.hdf5 have bounds .*; valid: equal bounds"):
        convert([one, two], tmp_path / "c.hdf5", to="robomimic")


# -- messages --------------------------------------------------------------------------------------


def test_a_file_that_another_process_writes_to_is_said_to_be_in_use(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5")
    code = (
        "import h5py, sys\n"
        "file = h5py.File(sys.argv[1], 'a')\n"
        "print('open', flush=True)\n"
        "sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"open\n"
        with pytest.raises(DataError, match="in use: another process has it open"):
            load(path)
        process.communicate()


def test_a_recording_of_robosuite_is_answered_with_the_command_that_converts_it(
    tmp_path: Path,
) -> None:
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        file["data/demo_1/states"] = np.zeros((3, 34))
    with pytest.raises(DataError, match=r"convert .* --to robomimic --task TASK"):
        load(tmp_path / "demo.hdf5")


# -- what strangers' files have otherwise ----------------------------------------------------------

LAST = np.arange(STEPS) == STEPS - 1


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


@pytest.mark.parametrize("value", [7, np.nan])
def test_a_success_that_is_neither_0_nor_1_is_found_in_a_step_that_is_left_out(
    tmp_path: Path, value: float
) -> None:
    path = write(tmp_path / "a.hdf5", put("successes", np.where(LAST, value, 1.0)))
    with pytest.raises(DataError, match=f"demo_0/successes: .* in row {STEPS - 1}; valid: 0 or 1"):
        load(path, last_step="drop")


def test_an_episode_without_steps_is_named(tmp_path: Path, capsys: Any) -> None:
    def empty(demo: Any) -> None:
        for key in ("obs/x", "actions", "rewards", "dones"):
            put(key, demo[key][:0])(demo)

    code, _, err = checked(write(tmp_path / "a.hdf5", empty), capsys)
    assert code == 1
    assert "data/demo_0/actions: shape (0, 7)" in err


def test_a_last_observation_that_is_not_finite_is_named_as_the_file_has_it(tmp_path: Path) -> None:
    observations = np.zeros((STEPS + 1, 3))
    observations[-1] = np.nan
    path = write(tmp_path / "a.hdf5", put("obs/x", observations))
    with pytest.raises(DataError, match=f"demo_0/obs/x: .* not finite in row {STEPS}"):
        load(path)


@pytest.mark.parametrize("value", [1.0, np.bool_(True), b"True", "true", np.array([True])])
def test_the_attribute_success_means_the_same_to_every_command(
    tmp_path: Path, capsys: Any, value: Any
) -> None:
    path = write(tmp_path / "a.hdf5", tell("success", value), next_obs=True)
    code, out, _ = checked(path, capsys)
    assert code == 0
    assert "read              4 episodes, 80 steps, reward 4, 4 successes" in out
    assert load(path).metadata["account"]["read"]["successes"] == EPISODES
    assert convert(path, tmp_path / "b.hdf5", to="robomimic").account.read.successes == EPISODES
    assert float(load(path, reward="success")[:]["next", "reward"].sum()) == EPISODES


def test_an_attribute_success_that_says_nothing_is_named_with_its_value(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", tell("success", 2), next_obs=True)
    with pytest.raises(DataError, match="attribute success is 2 instead of 0 or 1"):
        load(path, successful=True)
    assert load(path).metadata["account"]["read"]["successes"] == 0


def test_an_attribute_success_that_contradicts_successes_is_said(
    tmp_path: Path, capsys: Any
) -> None:
    edits = tell("success", True), put("successes", np.zeros(STEPS, bool))
    path = write(tmp_path / "a.hdf5", *edits, next_obs=True)
    says = "attribute success contradicts successes in 4 episodes, such as demo_0; "
    says += "successes are used"
    assert says in checked(path, capsys)[1]
    assert says in load(path).metadata["warnings"]


def test_the_attribute_success_goes_through_minari(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    path = write(tmp_path / "a.hdf5", tell("success", lambda i: bool(i % 2)), next_obs=True)
    target = tmp_path / "own" / "lift-v0"
    convert(path, target, to="minari")
    done = convert(target, tmp_path / "b.hdf5", to="robomimic", successful=True, reward="success")
    assert (done.account.read.episodes, done.account.read.reward) == (2, 2.0)


def test_what_is_left_out_is_rewarded_as_what_is_read(tmp_path: Path) -> None:
    """A sum of two sorts of reward would be none."""
    path = write(tmp_path / "a.hdf5", tell("success", lambda i: bool(i % 2)), next_obs=True)
    account = load(path, successful=True, reward="success").metadata["account"]
    assert (account["read"]["reward"], account["failed"]["reward"]) == (2.0, 0.0)


@pytest.mark.parametrize("name", ["demo_info", "demonstrations", "demo_0_meta"])
def test_a_data_set_that_is_named_nearly_like_a_demonstration_is_left_alone(
    tmp_path: Path, capsys: Any, name: str
) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    with h5py.File(path, "r+") as file:
        file[f"data/{name}"] = np.zeros(4)
    code, out, _ = checked(path, capsys)
    assert code == 0
    assert f"beside the demonstrations, not read: data/{name}" in out


@pytest.mark.parametrize("value", ["20", 20.0, np.array([20])])
def test_a_number_of_steps_is_no_contradiction_however_it_is_written(
    tmp_path: Path, capsys: Any, value: Any
) -> None:
    path = write(tmp_path / "a.hdf5", tell("num_samples", value), next_obs=True)
    assert "contradicts" not in checked(path, capsys)[1]


def test_a_faulty_mask_stops_loading_as_it_stops_the_other_commands(
    tmp_path: Path, capsys: Any
) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    with h5py.File(path, "r+") as file:
        file["mask/train"] = [b"demo_9"]
    assert checked(path, capsys)[0] == 1
    for read in (load, lambda path: convert(path, tmp_path / "b.hdf5", to="robomimic")):
        with pytest.raises(DataError, match="mask/train: row 0 names 'demo_9'"):
            read(path)


@pytest.mark.parametrize("to", ["minari", "lerobot"])
def test_parts_of_the_observation_are_chosen_from_every_format(
    tmp_path: Path, capsys: Any, to: str
) -> None:
    pytest.importorskip("minari" if to == "minari" else "pyarrow")
    more = put("obs/y", np.ones((STEPS, 2))), put("next_obs/y", np.ones((STEPS, 2)))
    path, source = write(tmp_path / "a.hdf5", *more, next_obs=True), tmp_path / "own" / "lift-v0"
    convert(path, source, to=to, fps=20)
    target = tmp_path / "b.hdf5"
    convert(source, target, to="robomimic", observation_keys=["y"], last_step="truncate")
    with h5py.File(target) as file:
        assert list(file["data/demo_0/obs"]) == ["y"]
    code, _, err = checked(source, capsys, "--observation-keys", "z", "--last-step", "drop")
    assert code == 1
    assert "episode_0/z: not a part of the observation; valid: x, y" in err


# -- bounds and several files, as strangers write them ---------------------------------------------


def test_whole_numbers_have_no_range_of_data(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", put("actions", np.full((STEPS, 7), 5)), next_obs=True)
    assert "action_bounds" not in load(path, bounds="data").metadata


@pytest.mark.parametrize("shape", [(STEPS,), (STEPS, 2, 3)])
def test_actions_that_are_no_vectors_have_one_range(
    tmp_path: Path, capsys: Any, shape: tuple[int, ...]
) -> None:
    pytest.importorskip("minari")
    actions = np.linspace(-3, 2, int(np.prod(shape))).reshape(shape)
    path = write(tmp_path / "a.hdf5", put("actions", actions), next_obs=True)
    assert checked(path, capsys, "--bounds", "data")[0] == 0
    target = tmp_path / "own" / "lift-v0"
    convert(path, target, to="minari", bounds="data")
    with open_source(target) as source:
        assert source.bounds == (-3.0, 2.0)


def test_bounds_may_be_an_array(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    told = load(path, bounds=np.array([-2.0, 2.0])).metadata["action_bounds"]
    assert told == {"low": -2.0, "high": 2.0}


def test_files_become_one_with_the_range_of_them_all(tmp_path: Path) -> None:
    low, high = np.linspace(-3, 0, STEPS)[:, None], np.linspace(0, 2, STEPS)[:, None]
    one = write(tmp_path / "a.hdf5", put("actions", low), next_obs=True)
    other = write(tmp_path / "b.hdf5", put("actions", high), next_obs=True)
    convert([one, other], tmp_path / "c.hdf5", to="robomimic", bounds="data")
    assert read_metadata(tmp_path / "c.hdf5")["action_bounds"] == {"low": [-3.0], "high": [2.0]}


def test_equal_bounds_are_equal_however_they_are_written(tmp_path: Path) -> None:
    one, other = (write(tmp_path / f"{name}.hdf5", next_obs=True) for name in "ab")
    with h5py.File(other, "r+") as file:
        file["data"].attrs["action_bounds"] = json.dumps({"low": [-1] * 7, "high": [1] * 7})
    done = convert([one, other], tmp_path / "c.hdf5", to="robomimic")
    assert done.account.read.episodes == 2 * EPISODES
    assert not any("action_bounds" in note for note in done.notes)


def test_a_mask_that_some_of_the_files_lack_is_said(tmp_path: Path) -> None:
    one, other = (write(tmp_path / f"{name}.hdf5", next_obs=True) for name in "ab")
    with h5py.File(one, "r+") as file:
        file["mask/train"] = [b"demo_0"]
    done = convert([one, other], tmp_path / "c.hdf5", to="robomimic")
    assert any(f"mask train has no episodes of {other}" in note for note in done.notes)


def test_an_iterator_of_keys_serves_all_files(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{name}.hdf5", next_obs=True) for name in "ab"]
    done = convert(files, tmp_path / "c.hdf5", to="robomimic", observation_keys=iter(["x"]))
    assert done.account.read.episodes == 2 * EPISODES
