"""The six tasks on the tabletop: starts, rewards, success, episodes, interfaces."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import gymnasium
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs.utils import check_env_specs

import torchrl_bmrl.envs  # registers the ids  # noqa: F401
from torchrl_bmrl.envs.arms import inverse_kinematics
from torchrl_bmrl.envs.registration import gymnasium_id
from torchrl_bmrl.envs.robosuite_names import robosuite_metadata
from torchrl_bmrl.envs.scene import (
    CUBE_HALF_SIZE,
    CUBE_RANGE,
    HOME,
    HOVER_HEIGHT,
    TABLE_TOP,
    TARGET_HIGH,
    TARGET_LOW,
    TabletopScene,
)
from torchrl_bmrl.envs.skills import REWARD_TERMS, SKILLS
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.experts.controllers import make_expert

pytestmark = pytest.mark.robosuite

TASKS = tuple(SKILLS)

CUBE_TASKS = [task for task in TASKS if task != "reach"]
PUSH_TASKS = [task for task in TASKS if task.startswith("push")]
DIRECTIONS = {
    "push_right": [0.0, -1.0, 0.0],
    "push_left": [0.0, 1.0, 0.0],
    "push_up": [1.0, 0.0, 0.0],
    "push_down": [-1.0, 0.0, 0.0],
}
IDS = {
    "reach": "bmrl/SawyerReach-v0",
    "lift": "bmrl/SawyerLift-v0",
    "push_right": "bmrl/SawyerPushRight-v0",
    "push_left": "bmrl/SawyerPushLeft-v0",
    "push_up": "bmrl/SawyerPushUp-v0",
    "push_down": "bmrl/SawyerPushDown-v0",
}
PARTS = {
    "robot0_joint_pos": 7,
    "robot0_gripper_qpos": 2,
    "robot0_joint_vel": 7,
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "goal_pos": 3,
}
ZERO = np.zeros(7, dtype=np.float32)


@pytest.fixture(scope="module")
def envs() -> Iterator[dict[str, TabletopEnv]]:
    made = {task: TabletopEnv(task) for task in TASKS}
    yield made
    for env in made.values():
        env.close()


def simulator(env: TabletopEnv) -> tuple[Any, Any]:
    """MuJoCo's own model and data, below the code under test."""
    sim = env.robosuite_env.sim
    return sim.model._model, sim.data._data


def eef(env: TabletopEnv) -> np.ndarray:
    return simulator(env)[1].site("gripper0_right_grip_site").xpos.copy()


def cube(env: TabletopEnv) -> np.ndarray:
    return simulator(env)[1].body("cube_main").xpos.copy()


def cube_velocity(env: TabletopEnv) -> np.ndarray:
    return simulator(env)[1].joint("cube_joint0").qvel[:3].copy()


def touches(env: TabletopEnv) -> set[str]:
    """Fingers ("l", "r") in contact with the cube."""
    model, data = simulator(env)
    found = set()
    for contact in data.contact[: data.ncon]:
        names = {model.geom(contact.geom1).name, model.geom(contact.geom2).name}
        if "cube_g0" in names:
            found |= {n.split("_")[2] for n in names if n.startswith("gripper0_right_")}
    return found


def place_cube(env: TabletopEnv, position: np.ndarray) -> None:
    _, data = simulator(env)
    data.joint("cube_joint0").qpos[:] = [*position, 1.0, 0.0, 0.0, 0.0]
    env.robosuite_env.sim.forward()


def place_fingers(env: TabletopEnv, opening: float) -> None:
    _, data = simulator(env)
    data.joint("gripper0_right_l_finger_joint").qpos[:] = opening
    data.joint("gripper0_right_r_finger_joint").qpos[:] = -opening
    env.robosuite_env.sim.forward()


def success(env: TabletopEnv) -> bool:
    return env.robosuite_env._check_success()


def episode(env: TabletopEnv, seed: int, actions: np.ndarray) -> np.ndarray:
    """Everything that an episode shows, row by row: reward, observation, info."""
    observation, info = env.reset(seed=seed)
    rows = [[0.0, *np.concatenate([*observation.values()]), *map(float, info.values())]]
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        rows.append([reward, *np.concatenate([*observation.values()]), *map(float, info.values())])
    return np.array(rows)


# -- interfaces ------------------------------------------------------------------------------------


def test_the_ids_are_those_of_the_tasks_and_one_for_compositions() -> None:
    assert {task: gymnasium_id(task) for task in TASKS} == IDS
    registered = {i for i in gymnasium.registry if i.startswith("bmrl/")}
    assert registered == {*IDS.values(), "bmrl/SawyerComposition-v0"}
    env = gymnasium.make("bmrl/SawyerComposition-v0")
    assert env.unwrapped.task == "reach-lift-reach"
    env.close()


@pytest.mark.filterwarnings("ignore:.*Box observation space m.*imum value is:UserWarning")
@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_wrong(task: str) -> None:
    env = gymnasium.make(IDS[task])
    check_env(env.unwrapped, skip_render_check=True)
    assert env.unwrapped.task == task
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_torchrl_finds_nothing_wrong(task: str) -> None:
    env = make_env(task)
    check_env_specs(env, seed=0)
    env.close()


def test_an_episode_is_truncated_at_200_and_never_terminated() -> None:
    env = gymnasium.make(IDS["push_left"])
    env.action_space.seed(0)
    env.reset(seed=0)
    ends = []
    while not ends or not ends[-1][1]:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        ends.append((terminated, truncated))
    env.close()
    assert ends == [(False, False)] * 199 + [(False, True)]


def test_torchrl_sees_the_truncation_and_no_termination() -> None:
    env = make_env("reach")
    after = env.rollout(250, auto_cast_to_device=False)["next"]
    env.close()
    assert len(after) == 200
    assert not after["terminated"].any()
    assert after["truncated"].flatten().tolist() == [False] * 199 + [True]
    assert after["done"].equal(after["truncated"])


@pytest.mark.parametrize("task", ["reach", "lift", "push_down"])
def test_success_and_reward_terms_reach_the_tensordict(task: str) -> None:
    env = make_env(task)
    torch.manual_seed(0)
    after = env.rollout(5)["next"]
    env.close()
    terms = torch.stack([after[f"reward_{name}"] for name in REWARD_TERMS])
    assert after["success"].dtype == torch.bool
    assert after["success"].shape == after["reward_reach"].shape == (5,)
    torch.testing.assert_close(terms.sum(0).float(), after["reward"].squeeze(-1))
    assert (after["reward_reach"] > 0).all()


def test_observation_is_a_dict_of_named_parts(envs: dict[str, TabletopEnv]) -> None:
    for env in envs.values():
        observation, _ = env.reset(seed=0)
        assert {name: part.shape for name, part in observation.items()} == {
            name: (size,) for name, size in PARTS.items()
        }
        assert env.observation_space.contains(observation)


@pytest.mark.parametrize("task", ["reach", "push_up"])
def test_parts_are_robosuites_observables_of_the_same_names(task: str) -> None:
    env = TabletopScene(task, seed=4)
    theirs, ours = env.reset(), env.named_observation()
    env.close()
    for name in PARTS:
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-9, err_msg=name)


def test_observation_has_the_33_numbers_in_the_documented_order(
    envs: dict[str, TabletopEnv],
) -> None:
    torchrl_env, env = make_env("lift"), envs["lift"]
    data = torchrl_env.reset(seed=11)
    parts, _ = env.reset(seed=11)
    for step in range(4):
        joints = parts["robot0_joint_pos"]
        expected = np.concatenate(
            [
                np.sin(joints),
                np.cos(joints),
                parts["robot0_gripper_qpos"],
                parts["robot0_joint_vel"],
                parts["robot0_eef_pos"],
                parts["robot0_eef_quat"],
                parts["goal_pos"],
            ]
        )
        assert data["observation"].shape == (33,)
        assert data["observation"].dtype == torch.float32
        torch.testing.assert_close(data["observation"], torch.tensor(expected).float())
        action = np.full(7, 0.3 * (step - 1), dtype=np.float32)
        parts, *_ = env.step(action)
        data = torchrl_env.step(data.set("action", torch.as_tensor(action)))["next"]
    torchrl_env.close()


def test_robosuite_rebuilds_a_task_from_the_metadata_of_a_dataset() -> None:
    import robosuite

    for task in ("reach", "push_right"):
        metadata = robosuite_metadata(task)
        env = robosuite.make(metadata["env_name"], **metadata["env_kwargs"])
        assert type(env).__name__ == metadata["env_name"]
        if task == "push_right":
            np.testing.assert_array_equal(env.skill.direction, DIRECTIONS[task])
        env.close()


# -- episodes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["reach", "lift", "push_left"])
def test_a_seed_reproduces_an_episode_exactly(envs: dict[str, TabletopEnv], task: str) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (30, 7)).astype(np.float32)
    first = episode(envs[task], 5, actions)
    assert (np.ptp(first[1:, 1:8], axis=0) > 0).all()  # every joint moved
    np.testing.assert_array_equal(episode(envs[task], 5, actions), first)
    episode(envs[task], 6, rng.uniform(-1, 1, (17, 7)).astype(np.float32))
    np.testing.assert_array_equal(episode(envs[task], 5, actions), first)
    fresh = TabletopEnv(task)
    np.testing.assert_array_equal(episode(fresh, 5, actions), first)
    fresh.close()


@pytest.mark.parametrize("task", ["reach", "lift"])
def test_seeds_and_unseeded_resets_start_differently(
    envs: dict[str, TabletopEnv], task: str
) -> None:
    env = envs[task]
    starts = [env.reset(seed=seed)[0] for seed in (0, 1)] + [env.reset()[0] for _ in range(2)]
    goals = np.stack([start["goal_pos"] for start in starts])
    assert len(np.unique(goals.round(6), axis=0)) == 4


def test_the_end_effector_of_reach_starts_within_1_cm_of_the_set_point(
    envs: dict[str, TabletopEnv],
) -> None:
    starts, goals = [], []
    for seed in range(20):
        observation, _ = envs["reach"].reset(seed=seed)
        starts.append(eef(envs["reach"]))
        goals.append(observation["goal_pos"])
    distances = np.linalg.norm(np.array(starts) - HOME, axis=1)
    assert distances.max() <= 0.01 + 1e-4
    assert distances.max() > 0.005  # a point for all of them would be another task
    assert (np.array(goals) >= TARGET_LOW).all()
    assert (np.array(goals) <= TARGET_HIGH).all()
    assert (np.std(goals, axis=0) > 0.03).all()


@pytest.mark.parametrize("task", CUBE_TASKS)
def test_the_gripper_starts_above_a_cube_at_rest(envs: dict[str, TabletopEnv], task: str) -> None:
    env = envs[task]
    places = []
    for seed in range(10):
        env.reset(seed=seed)
        start = cube(env)
        np.testing.assert_allclose(eef(env) - start, [0, 0, HOVER_HEIGHT], atol=1e-4)
        np.testing.assert_allclose(start[2], TABLE_TOP[2] + CUBE_HALF_SIZE, atol=1e-6)
        places.append(start[:2] - TABLE_TOP[:2])
        if seed < 3:
            for _ in range(5):
                env.step(ZERO)
            # Less than the contact's softness: it neither falls nor slides.
            np.testing.assert_allclose(cube(env), start, atol=3e-4)
    assert np.abs(places).max() <= CUBE_RANGE
    assert (np.std(places, axis=0) > 0.02).all()


@pytest.mark.parametrize("task", TASKS)
def test_a_zero_action_holds_the_start_whatever_was_done_before(
    envs: dict[str, TabletopEnv], task: str
) -> None:
    env = envs[task]
    env.reset(seed=1)
    for _ in range(12):  # away from the start, gripper closing: the controllers have a memory
        env.step(np.array([1, -1, 1, 0.5, 0, 0.5, 1], dtype=np.float32))
    assert env.robosuite_env.named_observation()["robot0_gripper_qpos"][0] < 0.005
    observation, _ = env.reset(seed=2)
    start, turned = eef(env), env.robosuite_env.eef_rotation
    fingers = observation["robot0_gripper_qpos"]
    assert fingers[0] > 0.011
    assert fingers[1] < -0.011
    for _ in range(5):
        observation, *_ = env.step(ZERO)
        assert np.linalg.norm(eef(env) - start) < 1e-4
        assert np.abs(env.robosuite_env.eef_rotation - turned).max() < 1e-3
        np.testing.assert_allclose(observation["robot0_gripper_qpos"], fingers, atol=1e-4)


def test_an_action_moves_the_end_effector_along_its_axis(envs: dict[str, TabletopEnv]) -> None:
    for axis in range(3):
        envs["reach"].reset(seed=0)
        start = eef(envs["reach"])
        for _ in range(5):
            envs["reach"].step(np.eye(7, dtype=np.float32)[axis])
        moved = eef(envs["reach"]) - start
        assert moved[axis] > 0.02
        assert np.abs(np.delete(moved, axis)).max() < 0.25 * moved[axis]


def test_the_gripper_closes_on_plus_one_and_opens_on_minus_one(
    envs: dict[str, TabletopEnv],
) -> None:
    env = envs["reach"]
    opened = env.reset(seed=0)[0]["robot0_gripper_qpos"]
    action = ZERO.copy()
    for command, expected in ((1.0, "closed"), (-1.0, "open")):
        action[6] = command
        for _ in range(15):
            fingers = env.step(action)[0]["robot0_gripper_qpos"]
        width, full = fingers[0] - fingers[1], opened[0] - opened[1]
        assert (width < 0.0) if expected == "closed" else (width > 0.8 * full)


# -- rewards ---------------------------------------------------------------------------------------


def expected_terms(env: TabletopEnv, cube_start: np.ndarray) -> dict[str, float]:
    """The rewards of the task, from the simulator's state alone."""
    task = env.task
    goal = simulator(env)[1].site("goal_marker").xpos if task == "reach" else cube(env)
    terms = dict.fromkeys(REWARD_TERMS, 0.0)
    terms["reach"] = 1 - np.tanh(10 * np.linalg.norm(eef(env) - goal) ** 2)
    if task == "lift":
        terms["grasp"] = float(touches(env) == {"l", "r"})
        terms["lift"] = float(cube(env)[2] - cube_start[2] > 0.05)
    if task.startswith("push"):
        velocity = cube_velocity(env)
        terms["velocity"] = 1 - np.tanh(np.linalg.norm(velocity - DIRECTIONS[task]))
        terms["distance"] = float(np.linalg.norm(cube(env) - cube_start) > 0.07)
    return terms


@pytest.mark.parametrize("task", TASKS)
def test_rewards_are_those_of_the_equations(envs: dict[str, TabletopEnv], task: str) -> None:
    env = envs[task]
    env.reset(seed=3)
    start = np.zeros(3) if task == "reach" else cube(env)
    expert = make_expert(env.robosuite_env)
    seen: dict[str, set[float]] = {name: set() for name in REWARD_TERMS}
    for _ in range(90):
        _, reward, _, _, info = env.step(expert().astype(np.float32))
        for name, value in expected_terms(env, start).items():
            assert info[f"reward_{name}"] == pytest.approx(value, abs=1e-7), name
            seen[name].add(round(float(value), 3))
        assert reward == pytest.approx(sum(info[f"reward_{name}"] for name in REWARD_TERMS))
        if info["success"] and len(seen["reach"]) > 5:
            break
    # The episode has shown every term at work, or the comparison says little.
    moving = {"reach": ["reach"], "lift": ["reach", "grasp", "lift"]}
    for name in REWARD_TERMS:
        active = name in moving.get(task, ["reach", "velocity", "distance"])
        assert (len(seen[name]) > 1) == active, name


def test_a_reset_gives_no_reward(envs: dict[str, TabletopEnv]) -> None:
    for env in envs.values():
        _, info = env.reset(seed=0)
        none = {f"reward_{name}": 0.0 for name in REWARD_TERMS}
        assert info == {"success": False, "stage": 0, **none}


# -- success ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance", "expected"), [(0.015, True), (0.025, False)])
def test_reach_succeeds_within_2_cm(
    envs: dict[str, TabletopEnv], distance: float, expected: bool
) -> None:
    env = envs["reach"]
    for seed, direction in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        observation, _ = env.reset(seed=seed)
        target = observation["goal_pos"] + distance * direction
        _, data = simulator(env)
        for i, angle in enumerate(inverse_kinematics(env.robosuite_env, target)):
            data.joint(f"robot0_right_j{i}").qpos[:] = angle
        env.robosuite_env.sim.forward()
        np.testing.assert_allclose(eef(env), target, atol=1e-4)
        assert success(env) == expected


@pytest.mark.parametrize(
    ("fingers", "height", "expected"),
    [(0.0, 0.06, True), (0.0, 0.04, False), (0.0115, 0.06, False), (0.0115, 0.04, False)],
)
def test_lift_succeeds_with_the_cube_grasped_and_5_cm_up(
    envs: dict[str, TabletopEnv], fingers: float, height: float, expected: bool
) -> None:
    env = envs["lift"]
    env.reset(seed=0)
    target = cube(env) + np.array([0.0, 0.0, height])
    _, data = simulator(env)
    for i, angle in enumerate(inverse_kinematics(env.robosuite_env, target)):
        data.joint(f"robot0_right_j{i}").qpos[:] = angle
    place_fingers(env, fingers)
    place_cube(env, target)
    assert (touches(env) == {"l", "r"}) == (fingers == 0.0)
    assert success(env) == expected


def test_a_cube_held_by_one_finger_is_not_grasped(envs: dict[str, TabletopEnv]) -> None:
    env = envs["lift"]
    env.reset(seed=0)
    place_fingers(env, 0.0115)
    _, data = simulator(env)
    left, right = (data.geom(f"gripper0_right_{side}_fingerpad_g0").xpos for side in "lr")
    place_cube(env, eef(env) + 0.015 * (left - right) / np.linalg.norm(left - right))
    assert len(touches(env)) == 1
    assert not success(env)


@pytest.mark.parametrize(
    ("along", "sideways", "expected"),
    [
        (0.08, 0.0, True),
        (0.08, 0.02, True),
        (0.08, -0.02, True),
        (0.08, 0.05, False),
        (0.08, -0.05, False),
        (0.06, 0.02, False),
        (-0.08, 0.0, False),
        (0.0, 0.08, False),
    ],
)
@pytest.mark.parametrize("task", PUSH_TASKS)
def test_push_succeeds_7_cm_along_and_little_sideways(
    envs: dict[str, TabletopEnv], task: str, along: float, sideways: float, expected: bool
) -> None:
    env = envs[task]
    env.reset(seed=0)
    direction = np.array(DIRECTIONS[task])
    across = np.cross([0.0, 0.0, 1.0], direction)
    place_cube(env, cube(env) + along * direction + sideways * across)
    assert success(env) == expected


@pytest.mark.parametrize("task", TASKS)
def test_no_task_starts_solved(envs: dict[str, TabletopEnv], task: str) -> None:
    for seed in range(10):
        envs[task].reset(seed=seed)
        assert not success(envs[task])


@pytest.mark.parametrize("task", TASKS)
def test_the_goal_marker_stands_at_the_goal(envs: dict[str, TabletopEnv], task: str) -> None:
    for seed in (0, 1):
        observation, _ = envs[task].reset(seed=seed)
        marker = simulator(envs[task])[1].site("goal_marker").xpos
        np.testing.assert_allclose(marker, observation["goal_pos"], atol=1e-6)


# -- pictures and text -----------------------------------------------------------------------------

RENDER = """
import sys
import mujoco
try:
    renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 32, 32)
    renderer.close()
except BaseException as error:
    print(f"{type(error).__name__}: {error}")
    sys.exit(77)
import numpy as np
from torchrl_bmrl.envs.tabletop import TabletopEnv
env = TabletopEnv("reach", render_mode="rgb_array", image_size=(256, 320))
env.reset(seed=1)
shown = env.render()
again = env.render()
env.robosuite_env.sim.model.site_rgba[env.robosuite_env._goal_site_id] = 0.0
hidden = env.render()
np.savez(sys.argv[1], shown=shown, again=again, hidden=hidden)
env.close()
"""


def test_the_goal_marker_is_visible_in_the_picture(tmp_path: Path) -> None:
    # In a process of its own: MUJOCO_GL is read when mujoco is first imported.
    environment = {"MUJOCO_GL": "egl", **os.environ}
    done = subprocess.run(
        [sys.executable, "-c", RENDER, str(tmp_path / "pictures.npz")],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    if done.returncode == 77:
        pytest.skip(f"MUJOCO_GL={environment['MUJOCO_GL']} cannot render: {done.stdout.strip()}")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "pictures.npz") as file:
        shown, again, hidden = file["shown"], file["again"], file["hidden"]
    assert shown.shape == (256, 320, 3)
    assert shown.dtype == np.uint8
    assert np.ptp(hidden) > 50  # a scene, not a blank page
    np.testing.assert_array_equal(shown, again)
    difference = np.abs(shown.astype(int) - hidden).max(-1)
    rows, columns = np.nonzero(difference > 40)
    assert len(rows) > 15
    assert max(np.ptp(rows), np.ptp(columns)) < 15  # one spot


def test_without_render_mode_there_is_no_picture(envs: dict[str, TabletopEnv]) -> None:
    assert envs["reach"].render() is None


SILENT = """
import gymnasium
import torchrl_bmrl.envs
from torchrl_bmrl.envs.transforms import make_env
env = gymnasium.make("bmrl/SawyerLift-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
env = make_env("reach")
env.rollout(2)
env.close()
"""


def test_importing_constructing_and_stepping_print_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SILENT], cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [TabletopEnv, make_env, TabletopScene, gymnasium_id])
def test_an_unknown_task_is_answered_with_the_valid_ones(make: Any) -> None:
    with pytest.raises(UnknownNameError, match="unknown task 'lfit'") as caught:
        make("lfit")
    assert all(task in str(caught.value) for task in TASKS)


def test_an_unknown_render_mode_is_answered_with_the_valid_one() -> None:
    with pytest.raises(UnknownNameError, match=r"'human'.*rgb_array"):
        TabletopEnv("reach", render_mode="human")


@pytest.mark.parametrize(
    "action",
    [np.full(7, np.nan), np.array([0, 0, 0, 0, 0, 0, np.inf]), np.zeros(6), np.zeros((1, 7))],
    ids=["nan", "inf", "six", "batch"],
)
def test_a_bad_action_is_refused_and_moves_nothing(
    envs: dict[str, TabletopEnv], action: np.ndarray
) -> None:
    env = envs["reach"]
    env.reset(seed=0)
    _, data = simulator(env)
    before = (data.time, data.qpos.copy())
    with pytest.raises(BMRLError, match=r"finite.*\(7,\)"):
        env.step(action)
    assert data.time == before[0]
    np.testing.assert_array_equal(data.qpos, before[1])
