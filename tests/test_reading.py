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
    says = "all of the reward (4) is at last steps, and lost"
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
    with pytest.raises(DataError, match=r"successes: all successes \(4\) are at last steps"):
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
    assert "left alone in the episodes: obs/datagen_info (4x)" in capsys.readouterr().out


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
    assert any("renamed: 2 episodes; demo_2 is demo_1 now" in note for note in done.notes)


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
        with pytest.raises(DataError, match="data/demo_0: neither an attribute success nor succ"):
            load(path, **option)
    path = write(tmp_path / "b.hdf5", tell("success", False), next_obs=True)
    with pytest.raises(DataError, match="no episode succeeded of 4"):
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
    assert "beside the demonstrations: data/config, data/index, extra" in out
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
    assert "total says 3 steps, the arrays have 80" in out
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
    assert "outside [-1.0, 1.0]; the option bounds takes others" in err
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
    with pytest.raises(DataError, match=r"actions: shape \(20, 7\), and bounds of 2 dimensions"):
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
    assert "left out, as the data set has no place for it: author" in told
    data = load(target)[:]
    assert data["episode"].unique().tolist() == list(range(12))
    masks = read_metadata(target)["masks"]
    assert masks == {"train": ["demo_0", "demo_3", "demo_5", "demo_7"]}


def test_files_of_other_bounds_do_not_become_one(tmp_path: Path) -> None:
    one = write(tmp_path / "a.hdf5", next_obs=True)
    two = write(tmp_path / "b.hdf5", next_obs=True)
    with h5py.File(two, "a") as file:
        file["data"].attrs["action_bounds"] = json.dumps({"low": -2, "high": 2})
    with pytest.raises(ConfigError, match=r"b\.hdf5 are bounded by .*; valid: equal bounds"):
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
