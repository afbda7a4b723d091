"""Files of other tools: rewards and successes, what is not read, and messages."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py
from file_edits import put
from tool_files import EPISODES, STEPS, checked, load, put_attribute, write

from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.convert import convert, open_source
from torchrl_bmrl.errors import ConfigError, DataError

# -- rewards and successes -------------------------------------------------------------------------


def isaac(demo: Any) -> None:
    """Changes an episode to Isaac Lab's layout: no rewards, an attribute, groups of states."""
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
    path = write(tmp_path / "a.hdf5", put_attribute("success", lambda i: i != 1), next_obs=True)
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


def test_what_is_left_out_is_rewarded_as_what_is_read(tmp_path: Path) -> None:
    """The sum of recorded rewards and rewards by success would have no meaning."""
    path = write(
        tmp_path / "a.hdf5", put_attribute("success", lambda i: bool(i % 2)), next_obs=True
    )
    account = load(path, successful=True, reward="success").metadata["account"]
    assert (account["read"]["reward"], account["failed"]["reward"]) == (2.0, 0.0)


def test_successes_decide_before_the_attribute(tmp_path: Path) -> None:
    solved = np.arange(STEPS) > 10
    path = write(
        tmp_path / "a.hdf5",
        put_attribute("success", False),
        put("successes", solved),
        next_obs=True,
    )
    assert len(load(path, successful=True)) == EPISODES * STEPS
    rewards = load(path, reward="success")[:]["next", "reward"].reshape(EPISODES, STEPS)
    assert (rewards.numpy() == solved).all()


def test_success_that_nobody_tells_cannot_be_chosen_by(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    for option in ({"successful": True}, {"reward": "success"}):
        with pytest.raises(DataError, match="data/demo_0: no attribute success and no succ"):
            load(path, **option)
    path = write(tmp_path / "b.hdf5", put_attribute("success", False), next_obs=True)
    with pytest.raises(DataError, match="none of 4 episodes succeeded"):
        load(path, successful=True)


@pytest.mark.parametrize("value", [1.0, np.bool_(True), b"True", "true", np.array([True])])
def test_the_attribute_success_means_the_same_to_every_command(
    tmp_path: Path, capsys: Any, value: Any
) -> None:
    path = write(tmp_path / "a.hdf5", put_attribute("success", value), next_obs=True)
    code, out, _ = checked(path, capsys)
    assert code == 0
    assert "read              4 episodes, 80 steps, reward 4, 4 successes" in out
    assert load(path).metadata["account"]["read"]["successes"] == EPISODES
    assert convert(path, tmp_path / "b.hdf5", to="robomimic").account.read.successes == EPISODES
    assert float(load(path, reward="success")[:]["next", "reward"].sum()) == EPISODES


def test_an_attribute_success_that_says_nothing_is_named_with_its_value(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", put_attribute("success", 2), next_obs=True)
    with pytest.raises(DataError, match="attribute success is 2 instead of 0 or 1"):
        load(path, successful=True)
    assert load(path).metadata["account"]["read"]["successes"] == 0


def test_an_attribute_success_that_contradicts_successes_is_said(
    tmp_path: Path, capsys: Any
) -> None:
    edits = put_attribute("success", True), put("successes", np.zeros(STEPS, bool))
    path = write(tmp_path / "a.hdf5", *edits, next_obs=True)
    says = "attribute success contradicts successes in 4 episodes, such as demo_0; "
    says += "successes are used"
    assert says in checked(path, capsys)[1]
    assert says in load(path).metadata["warnings"]


def test_the_attribute_success_goes_through_minari(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    path = write(
        tmp_path / "a.hdf5", put_attribute("success", lambda i: bool(i % 2)), next_obs=True
    )
    target = tmp_path / "own" / "lift-v0"
    convert(path, target, to="minari")
    done = convert(target, tmp_path / "b.hdf5", to="robomimic", successful=True, reward="success")
    assert (done.account.read.episodes, done.account.read.reward) == (2, 2.0)


# -- what is not read ------------------------------------------------------------------------------


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
    path = write(tmp_path / "a.hdf5", put_attribute("num_samples", STEPS - 1), next_obs=True)
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


@pytest.mark.parametrize("value", ["20", 20.0, np.array([20])])
def test_a_number_of_steps_is_no_contradiction_however_it_is_written(
    tmp_path: Path, capsys: Any, value: Any
) -> None:
    path = write(tmp_path / "a.hdf5", put_attribute("num_samples", value), next_obs=True)
    code, out, _ = checked(path, capsys)
    assert code == 0
    assert "contradicts" not in out


def test_observations_in_one_array_become_one_part(tmp_path: Path) -> None:
    x = np.random.default_rng(2).standard_normal((STEPS + 1, 5))

    def flatten(demo: Any) -> None:
        del demo["obs"], demo["next_obs"]
        demo["obs"], demo["next_obs"] = x[:-1], x[1:]

    path = write(tmp_path / "a.hdf5", flatten, next_obs=True)
    data = load(path)[:]
    np.testing.assert_array_equal(data["next", "observation"][:STEPS], x[1:])
    assert load(path, observation_keys=["observation"])[:]["observation"].shape == (80, 5)


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


# -- messages --------------------------------------------------------------------------------------


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
