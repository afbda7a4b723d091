"""Episodes of the six tasks: seeded starts, and how actions move the arm."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

from scene_state import TASKS, cube, eef, simulator

from torchrl_bmrl.envs.table import (
    CUBE_HALF_SIZE,
    CUBE_RANGE,
    HOME,
    HOVER_HEIGHT,
    TABLE_TOP,
    TARGET_HIGH,
    TARGET_LOW,
)
from torchrl_bmrl.envs.tabletop import TabletopEnv

pytestmark = pytest.mark.robosuite

CUBE_TASKS = [task for task in TASKS if task != "reach"]
ZERO = np.zeros(7, dtype=np.float32)


def episode(env: TabletopEnv, seed: int, actions: np.ndarray) -> np.ndarray:
    """Reward, observation and info of each step of an episode, one row per step."""
    observation, info = env.reset(seed=seed)
    rows = [[0.0, *np.concatenate([*observation.values()]), *map(float, info.values())]]
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        rows.append([reward, *np.concatenate([*observation.values()]), *map(float, info.values())])
    return np.array(rows)


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
    assert distances.max() > 0.005  # the starts differ
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
            # The cube neither falls nor slides: it moves less than its soft contact gives way.
            np.testing.assert_allclose(cube(env), start, atol=3e-4)
    assert np.abs(places).max() <= CUBE_RANGE
    assert (np.std(places, axis=0) > 0.02).all()


@pytest.mark.parametrize("task", TASKS)
def test_a_zero_action_holds_the_start_whatever_was_done_before(
    envs: dict[str, TabletopEnv], task: str
) -> None:
    env = envs[task]
    env.reset(seed=1)
    for _ in range(12):  # moves the arm and closes the gripper, which the controllers remember
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


@pytest.mark.parametrize("task", TASKS)
def test_the_goal_marker_stands_at_the_goal(envs: dict[str, TabletopEnv], task: str) -> None:
    for seed in (0, 1):
        observation, _ = envs[task].reset(seed=seed)
        marker = simulator(envs[task])[1].site("goal_marker").xpos
        np.testing.assert_allclose(marker, observation["goal_pos"], atol=1e-6)
