"""Rewards and success of the six tasks, recomputed from the simulator's state."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

from scene_state import DIRECTIONS, TASKS, cube, eef, simulator

from torchrl_bmrl.envs.arms import inverse_kinematics
from torchrl_bmrl.envs.skills import REWARD_TERMS
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.experts.controllers import make_expert

pytestmark = pytest.mark.robosuite

PUSH_TASKS = [task for task in TASKS if task.startswith("push")]


def cube_velocity(env: TabletopEnv) -> np.ndarray:
    return simulator(env)[1].joint("cube_joint0").qvel[:3].copy()


def touches(env: TabletopEnv) -> set[str]:
    """The fingers ("l", "r") that touch the cube."""
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


def expected_terms(env: TabletopEnv, cube_start: np.ndarray) -> dict[str, float]:
    """The task's reward terms, computed from the simulator's state."""
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
    # Every term of the task has changed in this episode, so the comparison covers all of them.
    moving = {"reach": ["reach"], "lift": ["reach", "grasp", "lift"]}
    for name in REWARD_TERMS:
        active = name in moving.get(task, ["reach", "velocity", "distance"])
        assert (len(seen[name]) > 1) == active, name


def test_a_reset_gives_no_reward(envs: dict[str, TabletopEnv]) -> None:
    for env in envs.values():
        _, info = env.reset(seed=0)
        none = {f"reward_{name}": 0.0 for name in REWARD_TERMS}
        assert info == {"success": False, "stage": 0, **none}


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
