"""The human demonstrations of 2018 become transitions of a task; skipped where they are absent."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("h5py")

import h5py
from recordings import assert_close, edit_states, read, relabelling_table
from scipy.spatial.transform import Rotation

from torchrl_bmrl.data.episodes import Episode, stack_episodes
from torchrl_bmrl.data.robosuite import TRACKING, open_episodes
from torchrl_bmrl.errors import DataError

pytestmark = pytest.mark.robosuite
HUMAN = Path(__file__).parents[2] / "shared/data/human_sawyer_lift"
CUBE_Z = 13
"""Column of the cube's height in the states of 2018."""
QUATERNION = slice(14, 18)


@pytest.fixture(scope="module")
def human() -> Path:
    if not (HUMAN / "demo.hdf5").is_file():
        pytest.skip("the human demonstrations (../shared/data/human_sawyer_lift) are not here")
    return HUMAN / "demo.hdf5"


@pytest.fixture(scope="module")
def human_episodes(human: Path) -> dict[str, Episode]:
    with open_episodes(human, task="lift") as episodes:
        return dict(episodes)


@pytest.fixture
def human_copy(human: Path, tmp_path: Path) -> Path:
    """A copy of the first demonstration, which a test may change."""
    (tmp_path / "models").mkdir()
    shutil.copyfile(human.parent / "models/model_1.xml", tmp_path / "models/model_1.xml")
    with h5py.File(human) as source, h5py.File(tmp_path / "demo.hdf5", "w") as target:
        target["data/demo_1/states"] = source["data/demo_1/states"][()]
        target["data/demo_1"].attrs["model_file"] = "model_1.xml"
    return tmp_path / "demo.hdf5"


@pytest.mark.parametrize("tracking", [1.0, TRACKING])
def test_the_human_demonstrations_become_the_beginning_of_a_lift(
    human: Path, tracking: float
) -> None:
    table = relabelling_table(human, task="lift", tracking=tracking)
    assert [(row.name, row.steps, row.recorded_rows) for row in table] == [
        ("demo_1", 233, 1058),
        ("demo_2", 188, 837),
    ]
    assert [row.duration for row in table] == pytest.approx([11.67, 9.44])
    for row in table:
        assert 0.02 < row.lift_height < 0.035
        assert row.grasped_at_end
        assert not row.success
        assert row.action_error < 5e-3
        assert row.rotation_error < 1e-3
        assert row.model_error < 1e-3
        assert row.saturated_share == 0


@pytest.mark.parametrize("name", ["demo_1", "demo_2"])
@pytest.mark.parametrize("tracking", [1.0, TRACKING])
def test_the_actions_add_up_to_the_recorded_path(human: Path, name: str, tracking: float) -> None:
    episode = read(human, name, tracking=tracking)
    position = episode.observations["robot0_eef_pos"][0].copy()
    rotation = Rotation.from_quat(episode.observations["robot0_eef_quat"][0])
    for k, action in enumerate(episode.actions.astype(np.float64)):
        position += 0.05 * tracking * action[:3]
        rotation = Rotation.from_rotvec(0.5 * tracking * action[3:6]) * rotation
        recorded = Rotation.from_quat(episode.next_observations["robot0_eef_quat"][k])
        assert np.linalg.norm(position - episode.next_observations["robot0_eef_pos"][k]) < 5e-3
        assert (rotation * recorded.inv()).magnitude() < 1e-3


@pytest.mark.parametrize("name", ["demo_1", "demo_2"])
def test_the_cube_stands_over_our_table_as_it_stood_over_theirs(
    human: Path, human_episodes: dict[str, Episode], name: str
) -> None:
    with h5py.File(human) as file:
        states = file[f"data/{name}/states"][()]
    cube = human_episodes[name].observations["goal_pos"]
    # Their table's centre is at x = 0.56 m, its surface at 0.8 m like ours.
    np.testing.assert_allclose(cube[0], states[0, 11:14] - [0.56, 0, 0], atol=1e-9)
    height = human_episodes[name].attributes["lift_height"]
    # The recording ends within 50 ms after the last step, while the cube still rises.
    rise = states[-1, CUBE_Z] - states[0, CUBE_Z]
    assert height < rise < height + 0.007
    assert 0.031 < rise < 0.034


def test_transitions_have_the_layout_that_trains(human_episodes: dict[str, Episode]) -> None:
    for episode in human_episodes.values():
        steps = len(episode)
        for name, part in episode.observations.items():
            assert part.dtype == np.float64
            np.testing.assert_array_equal(part[1:], episode.next_observations[name][:-1])
        assert episode.actions.shape == (steps, 7)
        assert episode.actions.dtype == np.float32
        assert np.abs(episode.actions).max() <= 1
        assert episode.rewards.dtype == np.float64
        assert episode.extras["successes"].dtype == bool
        assert not episode.terminated.any()
    data = stack_episodes(human_episodes.values(), task=1)
    assert data.batch_size == (233 + 188,)
    assert data["next", "truncated"].sum() == 2


def test_the_gripper_opens_tries_and_holds(human_episodes: dict[str, Episode]) -> None:
    for name, closings in (("demo_1", 2), ("demo_2", 1)):
        gripper = human_episodes[name].actions[:, 6]
        assert set(gripper) == {-1.0, 1.0}
        assert gripper[0] == -1  # the recordings begin with half-closed fingers that open
        assert (np.diff(gripper) > 0).sum() == closings
        assert (gripper[-10:] == 1).all()


@pytest.mark.parametrize("name", ["demo_1", "demo_2"])
def test_the_reward_pays_the_grasp_at_the_end_and_no_lift(
    human_episodes: dict[str, Episode], name: str
) -> None:
    rewards = human_episodes[name].rewards
    assert rewards[:100].max() < 1
    np.testing.assert_allclose(rewards[-5:], 2, atol=0.02)


def test_states_can_be_played_back_in_the_model_that_comes_with_them(
    human_episodes: dict[str, Episode],
) -> None:
    import mujoco

    episode = human_episodes["demo_1"]
    model = mujoco.MjModel.from_xml_string(episode.attributes["model_file"])
    data = mujoco.MjData(model)
    for k in (0, len(episode) // 2, len(episode) - 1):
        state = episode.extras["states"][k]
        data.qpos[:], data.qvel[:] = state[1 : 1 + model.nq], state[1 + model.nq :]
        mujoco.mj_forward(model, data)
        site = data.site("gripper0_right_grip_site").xpos
        np.testing.assert_allclose(site, episode.observations["robot0_eef_pos"][k], atol=1e-5)
    np.testing.assert_allclose(model.geom("cube_g0").size, [0.02110, 0.02017, 0.02012], atol=1e-5)


def test_names_and_extras_of_other_dates_change_nothing(
    human: Path, human_episodes: dict[str, Episode], tmp_path: Path
) -> None:
    (tmp_path / "models").mkdir()
    shutil.copyfile(human.parent / "models/model_1.xml", tmp_path / "models/model1.xml")
    with h5py.File(human) as source, h5py.File(tmp_path / "demo.hdf5", "w") as target:
        source.copy("data/demo_1", target.create_group("data"), name="demo1")
        target["data/demo1"].attrs["model_file"] = "model1.xml"
        target["data/demo1/actions"] = np.zeros((1058, 8))
        target["data/demo1/starts"] = np.zeros(3)
    assert_close(human_episodes["demo_1"], read(tmp_path / "demo.hdf5", "demo1"))


def test_neither_the_sign_of_a_quaternion_nor_repeated_rows_change_anything(
    human_copy: Path, human_episodes: dict[str, Episode]
) -> None:
    def change(states: np.ndarray) -> np.ndarray:
        states[5::7, QUATERNION] *= -1
        return np.repeat(states, 2, axis=0)

    edit_states(human_copy, change)
    assert_close(human_episodes["demo_1"], read(human_copy))


def test_rows_that_are_missing_here_and_there_hardly_matter(
    human_copy: Path, human_episodes: dict[str, Episode]
) -> None:
    keep = np.random.default_rng(0).random(1058) < 0.7
    keep[[0, -1]] = True
    edit_states(human_copy, lambda states: states[keep])
    path = read(human_copy).observations["robot0_eef_pos"]
    expected = human_episodes["demo_1"].observations["robot0_eef_pos"]
    assert np.linalg.norm(path - expected, axis=1).max() < 1e-3


def test_the_same_scene_serves_a_push(human: Path) -> None:
    episode = read(human, task="push_left")
    assert len(episode) == 233
    assert not episode.extras["successes"].any()


def test_a_lift_does_not_say_where_to_reach(human_copy: Path) -> None:
    with pytest.raises(DataError, match="goal_marker"):
        read(human_copy, task="reach")


def test_a_missing_model_file_lists_those_that_are_there(human_copy: Path) -> None:
    with h5py.File(human_copy, "r+") as file:
        file["data/demo_1"].attrs["model_file"] = "model_3.xml"
    with pytest.raises(DataError, match=r"model_3.xml is missing; there: model_1.xml"):
        read(human_copy)


def test_the_source_stays_as_it_is(human_copy: Path) -> None:
    files = sorted(path for path in human_copy.parent.rglob("*") if path.is_file())
    before = [path.read_bytes() for path in files]
    relabelling_table(human_copy, task="lift")
    assert files == sorted(path for path in human_copy.parent.rglob("*") if path.is_file())
    assert before == [path.read_bytes() for path in files]
