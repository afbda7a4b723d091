"""robosuite's recordings as transitions: recomputed by the task, and refused when damaged.

Two kinds of recordings: the human demonstrations of 2018 (skipped where they are absent), and an
episode of our own lift recorded the way that today's robosuite does it.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("h5py")

import h5py
from scipy.spatial.transform import Rotation

from torchrl_bmrl.data.episodes import Episode, stack_episodes
from torchrl_bmrl.data.robosuite import (
    TRACKING,
    Relabelling,
    _gripper_commands,
    open_episodes,
)
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError, UnknownNameError
from torchrl_bmrl.experts.controllers import make_expert

pytestmark = pytest.mark.robosuite

HUMAN = Path(__file__).parents[2] / "shared/data/human_sawyer_lift"
CUBE_Z = 13
"""Column of the cube's height in the states of 2018."""
QUATERNION = slice(14, 18)
Damage = Callable[[Any], None]


@dataclass
class Recorded:
    """What the environment itself said while it was recorded."""

    path: Path
    observations: list[dict[str, np.ndarray]]
    actions: np.ndarray
    rewards: list[float]
    successes: list[bool]


def record(path: Path, task: str, steps: int, seed: int = 0) -> Recorded:
    """Records an episode of a task's expert in the layout of today's robosuite."""
    env = TabletopScene(task, use_object_obs=False, seed=seed)
    env.reset()
    expert = make_expert(env)
    observations, states = [env.named_observation()], [env.sim.get_state().flatten()]
    actions, rewards, successes = [], [], []
    for _ in range(steps):
        actions.append(np.clip(expert(), -1, 1))
        env.step(actions[-1])
        observations.append(env.named_observation())
        states.append(env.sim.get_state().flatten())
        rewards.append(env.reward())
        successes.append(env._check_success())
    with h5py.File(path, "w") as file:
        file["data/demo_1/states"] = np.stack(states)
        file["data/demo_1/actions"] = np.stack(actions)
        file["data/demo_1"].attrs["model_file"] = env.sim.model.get_xml()
    env.close()
    return Recorded(path, observations, np.stack(actions), rewards, successes)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("own") / "demo.hdf5", "lift", 90)


@pytest.fixture(scope="module")
def own_episode(own: Recorded) -> Episode:
    return read(own.path, tracking=TRACKING)


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
def copy(own: Recorded, tmp_path: Path) -> Path:
    return Path(shutil.copy(own.path, tmp_path / "demo.hdf5"))


@pytest.fixture
def human_copy(human: Path, tmp_path: Path) -> Path:
    """The first demonstration alone, free to be changed."""
    (tmp_path / "models").mkdir()
    shutil.copyfile(human.parent / "models/model_1.xml", tmp_path / "models/model_1.xml")
    with h5py.File(human) as source, h5py.File(tmp_path / "demo.hdf5", "w") as target:
        target["data/demo_1/states"] = source["data/demo_1/states"][()]
        target["data/demo_1"].attrs["model_file"] = "model_1.xml"
    return tmp_path / "demo.hdf5"


def read(path: Path, name: str = "demo_1", task: str = "lift", **options: Any) -> Episode:
    with open_episodes(path, task=task, **options) as episodes:
        return episodes[name]


def relabelling_table(path: Path, **options: Any) -> list[Relabelling]:
    with open_episodes(path, **options) as episodes:
        return [Relabelling.of(name, episode) for name, episode in episodes.items()]


def edit(path: Path, change: Callable[[np.ndarray], np.ndarray | None]) -> None:
    """Replaces the states of the first demonstration."""
    with h5py.File(path, "r+") as file:
        states = file["data/demo_1/states"][()]
        changed = change(states)
        del file["data/demo_1/states"]
        file["data/demo_1/states"] = states if changed is None else changed


def edit_model(path: Path, pattern: str, replacement: str) -> None:
    with h5py.File(path, "r+") as file:
        attributes = file["data/demo_1"].attrs
        text, count = re.subn(pattern, replacement, attributes["model_file"])
        assert count
        attributes["model_file"] = text


def assert_same(one: Episode, two: Episode, tolerance: float = 1e-9) -> None:
    for name, part in one.observations.items():
        np.testing.assert_allclose(two.observations[name], part, atol=tolerance)
    np.testing.assert_allclose(two.actions, one.actions, atol=max(tolerance, 1e-6))
    np.testing.assert_allclose(two.rewards, one.rewards, atol=max(tolerance, 1e-9))


# -- the human demonstrations ----------------------------------------------------------------------


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
    # The recording ends within 50 ms after the last step, with the cube on its way up.
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
    assert_same(human_episodes["demo_1"], read(tmp_path / "demo.hdf5", "demo1"))


def test_neither_the_sign_of_a_quaternion_nor_repeated_rows_change_anything(
    human_copy: Path, human_episodes: dict[str, Episode]
) -> None:
    def change(states: np.ndarray) -> np.ndarray:
        states[5::7, QUATERNION] *= -1
        return np.repeat(states, 2, axis=0)

    edit(human_copy, change)
    assert_same(human_episodes["demo_1"], read(human_copy))


def test_rows_that_are_missing_here_and_there_hardly_matter(
    human_copy: Path, human_episodes: dict[str, Episode]
) -> None:
    keep = np.random.default_rng(0).random(1058) < 0.7
    keep[[0, -1]] = True
    edit(human_copy, lambda states: states[keep])
    path = read(human_copy).observations["robot0_eef_pos"]
    expected = human_episodes["demo_1"].observations["robot0_eef_pos"]
    assert np.linalg.norm(path - expected, axis=1).max() < 1e-3


def test_the_same_scene_serves_a_push(human: Path) -> None:
    episode = read(human, task="push_left")
    assert len(episode) == 233
    assert not episode.extras["successes"].any()


def test_the_source_stays_as_it_is(human_copy: Path) -> None:
    files = sorted(path for path in human_copy.parent.rglob("*") if path.is_file())
    before = [path.read_bytes() for path in files]
    relabelling_table(human_copy, task="lift")
    assert files == sorted(path for path in human_copy.parent.rglob("*") if path.is_file())
    assert before == [path.read_bytes() for path in files]


# -- today's recordings ----------------------------------------------------------------------------


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


def test_a_lift_does_not_say_where_to_reach(human_copy: Path) -> None:
    with pytest.raises(DataError, match="goal_marker"):
        read(human_copy, task="reach")


def test_a_model_may_lie_in_a_file_or_in_the_attribute(copy: Path, own_episode: Episode) -> None:
    (copy.parent / "models").mkdir()
    with h5py.File(copy, "r+") as file:
        attributes = file["data/demo_1"].attrs
        (copy.parent / "models/model_1.xml").write_text(attributes["model_file"])
        attributes["model_file"] = "model_1.xml"
    assert_same(own_episode, read(copy, tracking=TRACKING))


# -- fingers ---------------------------------------------------------------------------------------

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


def set_value(index: tuple[int, int], value: float) -> Callable[[np.ndarray], None]:
    def change(states: np.ndarray) -> None:
        states[index] = value

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
    edit(copy, change)
    with pytest.raises(DataError, match=message) as caught:
        read(copy)
    assert caught.value.path == copy
    assert caught.value.key == "data/demo_1/states"


def test_missing_states_are_refused(copy: Path) -> None:
    with h5py.File(copy, "r+") as file:
        del file["data/demo_1/states"]
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


def test_a_missing_model_file_lists_those_that_are_there(human_copy: Path) -> None:
    with h5py.File(human_copy, "r+") as file:
        file["data/demo_1"].attrs["model_file"] = "model_3.xml"
    with pytest.raises(DataError, match=r"model_3.xml is missing; there: model_1.xml"):
        read(human_copy)


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
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git-LFS"),
    ],
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
    with pytest.raises(DataError):
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
    assert issubclass(ConfigError, BMRLError)


# -- hundreds of odd recordings --------------------------------------------------------------------


def fewer_rows(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    keep = np.sort(rng.choice(len(states), rng.integers(3, len(states)), replace=False))
    put_states(demo, states[keep])
    return bool((np.diff(states[keep, 0]) <= 0.1 + 1e-9).all())


def other_times(demo: Any, rng: np.random.Generator) -> bool:
    """Other rates, and rows at the same time, as recordings of 2018 have them."""
    states = demo["states"][()]
    gaps = rng.choice([0.0, 0.01, 0.024, 0.05, 0.09], len(states) - 1)
    gaps[0] = 0.09
    states[1:, 0] = states[0, 0] + np.cumsum(gaps)
    put_states(demo, states)
    return True


def backwards(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    row = int(rng.integers(1, len(states)))
    states[row:, 0] -= 0.07
    put_states(demo, states)
    return False


def not_finite(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    states[rng.integers(len(states)), rng.integers(states.shape[1])] = rng.choice([np.nan, np.inf])
    put_states(demo, states)
    return False


def another_width(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    put_states(demo, states[:, : -int(rng.integers(1, 8))])
    return False


def another_dtype(demo: Any, rng: np.random.Generator) -> bool:
    kind = str(rng.choice(["f4", ">f8", "S8", "c16"]))
    put_states(demo, demo["states"][()].astype(kind))
    return kind in ("f4", ">f8")


def more_beside(demo: Any, rng: np.random.Generator) -> bool:
    """What other versions and tools keep there."""
    demo["actions_abs"] = rng.random((3, 7))
    demo["notes"] = "a person's first try"
    demo.create_group("obs_raw")["x"] = rng.random(4)
    demo.attrs["success"] = str(rng.choice(["yes", "no"]))
    demo.parent.attrs["total"] = int(rng.integers(100))
    return True


def another_joint(demo: Any, rng: np.random.Generator) -> bool:
    joint = f"robot0_right_j{rng.integers(7)}"
    demo.attrs["model_file"] = demo.attrs["model_file"].replace(f'"{joint}"', '"elbow"')
    return False


def put_states(demo: Any, states: np.ndarray) -> None:
    del demo["states"]
    demo["states"] = states


ODD = (
    fewer_rows,
    other_times,
    backwards,
    not_finite,
    another_width,
    another_dtype,
    more_beside,
    another_joint,
)


def test_every_odd_recording_is_refused_by_name_or_gives_a_step_for_each_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.envs import scene

    whole = record(tmp_path / "whole.hdf5", "lift", 12)
    env = TabletopScene("lift", use_object_obs=False)
    monkeypatch.setattr(env, "close", lambda: None)
    monkeypatch.setattr(scene, "TabletopScene", lambda *_, **__: env)  # one for all files
    outcomes = {True: 0, False: 0}
    for number in range(208):
        change = ODD[number % len(ODD)]
        path = Path(shutil.copy(whole.path, tmp_path / f"{number}.hdf5"))
        with h5py.File(path, "r+") as file:
            valid = change(file["data/demo_1"], np.random.default_rng(number))
            states = file["data/demo_1/states"][()]
        outcomes[valid] += 1
        if not valid:
            with pytest.raises(DataError, match=f"{path}: data/demo_1"):
                read(path)
            continue
        times = states[:, 0].astype(np.float64)
        episode = read(path)
        assert len(episode) == int((times[-1] - times[0]) * env.control_freq + 1e-6), number
        assert len(episode.rewards) == len(episode.extras["successes"]) == len(episode)
        assert episode.left_out.steps == 0
        assert Relabelling.of("demo_1", episode).recorded_rows == len(states)
    assert min(outcomes.values()) >= 70, outcomes
