"""Recordings of robosuite 1.5 become the environment's own transitions, or are refused."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("h5py")

import h5py
from file_edits import LFS_POINTER, edit, remove
from recordings import Recorded, assert_close, edit_states, read, record, relabelling_table

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robosuite import TRACKING, Relabelling, _gripper_commands, open_episodes
from torchrl_bmrl.errors import ConfigError, DataError, UnknownNameError

pytestmark = pytest.mark.robosuite


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("own") / "demo.hdf5", "lift", 90)


@pytest.fixture(scope="module")
def own_episode(own: Recorded) -> Episode:
    return read(own.path, tracking=TRACKING)


@pytest.fixture
def copy(own: Recorded, tmp_path: Path) -> Path:
    return Path(shutil.copy(own.path, tmp_path / "demo.hdf5"))


def edit_model(path: Path, pattern: str, replacement: str) -> None:
    """Replaces text in the model of the first demonstration."""
    with h5py.File(path, "r+") as file:
        attributes = file["data/demo_1"].attrs
        text, count = re.subn(pattern, replacement, attributes["model_file"])
        assert count
        attributes["model_file"] = text


def test_relabelled_observations_and_rewards_are_the_environments_own(
    own: Recorded, own_episode: Episode
) -> None:
    assert len(own_episode) == len(own.actions)
    for name, part in own_episode.observations.items():
        recorded = np.stack([row[name] for row in own.observations])
        np.testing.assert_allclose(part, recorded[:-1], atol=1e-6)
        np.testing.assert_allclose(own_episode.next_observations[name], recorded[1:], atol=1e-6)
    np.testing.assert_allclose(own_episode.rewards, own.rewards, atol=1e-6)
    np.testing.assert_array_equal(own_episode.extras["successes"], own.successes)
    assert any(own.successes)


def test_states_of_todays_recordings_are_kept(own: Recorded, own_episode: Episode) -> None:
    with h5py.File(own.path) as file:
        states = file["data/demo_1/states"][()]
    np.testing.assert_allclose(own_episode.extras["states"], states[:-1], atol=1e-9)


def test_relabelled_actions_are_about_what_was_commanded(
    own: Recorded, own_episode: Episode
) -> None:
    relabelled, commanded = own_episode.actions[:, :3], own.actions[:, :3]
    moving = np.linalg.norm(commanded, axis=1) > 0.1
    cosine = (relabelled * commanded).sum(1) / (
        np.linalg.norm(relabelled, axis=1) * np.linalg.norm(commanded, axis=1)
    )
    assert np.median(cosine[moving]) > 0.95
    slope = (relabelled * commanded).sum() / (commanded**2).sum()
    assert 0.75 < slope < 1.25
    # The fingers lag behind the command to close by a step or two.
    assert (own_episode.actions[:, 6] == np.sign(own.actions[:, 6])).mean() > 0.95


def test_the_table_of_a_lift_that_succeeds(own: Recorded) -> None:
    (row,) = relabelling_table(own.path, task="lift")
    assert isinstance(row, Relabelling)
    assert row.success
    assert row.grasped_at_end
    assert row.lift_height > 0.05
    assert row.duration == pytest.approx(90 / 20)
    assert row.model_error < 1e-5
    assert row.action_error < 1e-5


def test_a_recorded_reach_keeps_its_goal(tmp_path: Path) -> None:
    recorded = record(tmp_path / "demo.hdf5", "reach", 10)
    episode = read(recorded.path, task="reach")
    goal = recorded.observations[0]["goal_pos"]
    np.testing.assert_allclose(episode.observations["goal_pos"], np.tile(goal, (10, 1)), atol=1e-6)
    np.testing.assert_allclose(episode.rewards, recorded.rewards, atol=1e-6)
    (row,) = relabelling_table(recorded.path, task="reach")
    assert np.isnan(row.lift_height)
    assert not row.grasped_at_end


def test_a_model_may_lie_in_a_file_or_in_the_attribute(copy: Path, own_episode: Episode) -> None:
    (copy.parent / "models").mkdir()
    with h5py.File(copy, "r+") as file:
        attributes = file["data/demo_1"].attrs
        (copy.parent / "models/model_1.xml").write_text(attributes["model_file"])
        attributes["model_file"] = "model_1.xml"
    assert_close(own_episode, read(copy, tracking=TRACKING))


@pytest.mark.parametrize("linked", ["models", "models/model_1.xml"])
def test_a_model_behind_a_link_is_refused(copy: Path, tmp_path: Path, linked: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "models").mkdir(parents=True)
    with h5py.File(copy, "r+") as file:
        attributes = file["data/demo_1"].attrs
        (elsewhere / "models/model_1.xml").write_text(attributes["model_file"])
        attributes["model_file"] = "model_1.xml"
    if linked != "models":
        (copy.parent / "models").mkdir()
    (copy.parent / linked).symlink_to(elsewhere / linked)
    with pytest.raises(DataError, match=r"model_1\.xml is behind a link; valid: a file"):
        read(copy, tracking=TRACKING)


OPENINGS = {
    "open, close on nothing, open": (
        [23, 23, 18, 10, 0, -10, -22, -22, -22, -15, 0, 20, 23, 23],
        [-1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1],
    ),
    "a squeezed cube pushes back": ([23, 8, -4, -7, -5, -3, -2, -2], [1, 1, 1, 1, 1, 1, 1]),
    "holding from the start": ([0, 0, 0, 0], [1, 1, 1]),
    "half open, opening": ([-17, 2, 12, 22, 23], [-1, -1, -1, -1]),
    "trembling while open": ([23, 22.4, 23.1, 22.5, 23], [-1, -1, -1, -1]),
}


@pytest.mark.parametrize("case", OPENINGS)
def test_gripper_commands_are_read_off_the_fingers(case: str) -> None:
    opening, expected = OPENINGS[case]
    assert _gripper_commands(np.array(opening) * 1e-3).tolist() == expected


# -- bad input -------------------------------------------------------------------------------------


def set_value(index: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Changes one number of the states."""

    def change(states: np.ndarray) -> np.ndarray:
        states[index] = value
        return states

    return change


BAD_STATES = {
    "not finite": (set_value((7, 3), np.nan), "not finite in row 7"),
    "too few columns": (lambda states: states[:, :-1], r"shape \(91, 31\); valid: \(T, 32\)"),
    "one dimension": (lambda states: states[0], "shape"),
    "no rows": (lambda states: states[:0], "rows: 0"),
    "one row": (lambda states: states[:1], "rows: 1"),
    "one moment": (lambda states: np.tile(states[:1], (5, 1)), "rows at 20 Hz: 1"),
    "time restarts": (
        lambda states: np.vstack([states[:9], states[:9]]),
        "in row 9; valid: forward",
    ),
    "a gap": (lambda states: np.delete(states, range(20, 40), axis=0), "in row 20; valid"),
    "no quaternion": (set_value((4, 13), 3.0), "not a unit quaternion in row 4"),
}


@pytest.mark.parametrize("case", BAD_STATES)
def test_bad_states_are_refused_with_key_and_row(copy: Path, case: str) -> None:
    change, message = BAD_STATES[case]
    edit_states(copy, change)
    with pytest.raises(DataError, match=message) as caught:
        read(copy)
    assert caught.value.path == copy
    assert caught.value.key == "data/demo_1/states"


def test_missing_states_are_refused(copy: Path) -> None:
    edit(copy, remove("data/demo_1/states"))
    with pytest.raises(DataError, match="data/demo_1/states: missing"):
        read(copy)


BAD_MODELS = {
    "not XML": (".*", "<mujoco", "does not compile"),
    "not MJCF": ("<worldbody>", "<worldbody><sphere/>", "does not compile"),
    "another robot's joints": ("robot0_right_j3", "robot0_joint3", "0 x joint ...right_j3; there:"),
    "one joint more than the states have": (
        '<body name="cube_main">',
        '<body><joint name="robot1_right_j0"/><geom size="1"/></body><body name="cube_main">',
        "shape",
    ),
    "no cube": ("cube_joint0", "ball_joint0", "0 x joint ...cube"),
    "no table": ("table_collision", "bin_collision", "0 x geom ...table_collision"),
    "a robot elsewhere": (
        '(<body name="robot0_base" pos=")-0.56',
        r"\g<1>-0.54",
        "20.0 mm from where the task's model has it",
    ),
}


@pytest.mark.parametrize("case", BAD_MODELS)
def test_models_that_do_not_fit_are_refused(copy: Path, case: str) -> None:
    pattern, replacement, message = BAD_MODELS[case]
    edit_model(copy, f"(?s){pattern}" if case == "not XML" else pattern, replacement)
    with pytest.raises(DataError, match=re.escape(message)) as caught:
        read(copy)
    assert caught.value.path == copy
    assert "data/demo_1" in str(caught.value)


def test_a_missing_model_attribute_is_refused(copy: Path) -> None:
    with h5py.File(copy, "r+") as file:
        del file["data/demo_1"].attrs["model_file"]
    with pytest.raises(DataError, match="data/demo_1/model_file: missing attribute"):
        read(copy)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", "not a complete HDF5 file"),
        (LFS_POINTER, "git-LFS"),
    ],
    ids=["missing", "empty", "pointer"],
)
def test_files_that_are_no_recordings_are_refused(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "demo.hdf5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=message), open_episodes(path, task="lift"):
        pass


def test_a_truncated_file_is_refused(copy: Path) -> None:
    copy.write_bytes(copy.read_bytes()[:-3000])
    with pytest.raises(DataError, match="not a complete HDF5 file"):
        read(copy)


def test_a_file_without_demonstrations_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        file.create_group("data")
    with (
        pytest.raises(DataError, match="no demonstrations"),
        open_episodes(tmp_path / "demo.hdf5", task="lift"),
    ):
        pass


def test_bad_options_are_refused_before_the_file_is_opened(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="lft"), open_episodes(tmp_path, task="lft"):
        pass
    for tracking in (0.0, -1.0, 1.5, float("nan")):
        with (
            pytest.raises(ConfigError, match="tracking"),
            open_episodes(tmp_path, task="lift", tracking=tracking),
        ):
            pass
