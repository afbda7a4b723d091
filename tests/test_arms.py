"""Other arms solve the same tasks; tasks are values that a process without a registry can use."""

from __future__ import annotations

import multiprocessing
import pickle
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import gymnasium
from torchrl.envs.utils import check_env_specs

import torchrl_bmrl.envs  # registers the ids  # noqa: F401
from torchrl_bmrl.envs.arms import ARMS
from torchrl_bmrl.envs.robosuite_names import robosuite_metadata
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.envs.skills import SKILLS, Push, describe_skill, make_skills
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.experts.tabletop import compose_tasks
from torchrl_bmrl.tasks import get_task

pytestmark = pytest.mark.robosuite

JOINTS = {"Sawyer": (7, 2), "Panda": (7, 2), "UR5e": (6, 6), "IIWA": (7, 6), "Kinova3": (7, 6)}


def record(task: Any, seed: int, **options: Any) -> Any:
    return task.record(seed, noise=0.2, **{**task.options, **options})


@pytest.mark.parametrize("robot", JOINTS)
def test_the_observation_has_the_size_of_the_arm(robot: str) -> None:
    joints, fingers = JOINTS[robot]
    env = TabletopEnv("lift", robot=robot)
    observation, _ = env.reset(seed=0)
    assert observation["robot0_joint_pos"].shape == observation["robot0_joint_vel"].shape
    assert observation["robot0_joint_pos"].shape == (joints,)
    assert observation["robot0_gripper_qpos"].shape == (fingers,)
    assert env.action_space.shape == (7,)
    env.close()


@pytest.mark.parametrize("robot", [arm for arm in ARMS if arm != "Jaco"])
def test_an_arm_starts_at_rest_with_an_open_gripper(robot: str) -> None:
    env = TabletopEnv("lift", robot=robot)
    for seed in range(2):
        env.reset(seed=seed)
        scene = env.robosuite_env
        np.testing.assert_allclose(scene.eef_position, scene.above_cube, atol=1e-4)
        assert not scene.gripper.closing
        gap = scene.gripper.gap
        assert gap > 0.06
        start = scene.eef_position
        for _ in range(5):
            env.step(np.array([0, 0, 0, 0, 0, 0, -1.0]))
        assert np.linalg.norm(scene.eef_position - start) < 2e-3
        assert abs(scene.gripper.gap - gap) < 5e-3
        for _ in range(12):
            env.step(np.array([0, 0, 0.5, 0, 0, 0, 1.0]))
        assert scene.gripper.closing
        assert scene.gripper.gap < gap - 0.02
    env.close()


def test_the_fingers_at_rest_are_simulated_once_for_each_model() -> None:
    scene = TabletopScene("lift", robots="Panda", seed=0)
    gripper = scene.gripper
    scene.reset()
    assert scene.gripper is gripper
    scene.hard_reset = True
    scene.reset()
    assert scene.gripper is not gripper
    assert scene.gripper.model is scene.robots[0].gripper["right"]
    np.testing.assert_array_equal(scene.gripper.open_fingers, gripper.open_fingers)
    scene.close()


@pytest.mark.parametrize("task", SKILLS)
def test_panda_solves_every_task(task: str) -> None:
    assert record(get_task(task), 0, robot="Panda").extras["successes"].any()


@pytest.mark.parametrize(
    "options", [{"robot": "IIWA"}, {"robot": "UR5e", "gripper": "Robotiq140Gripper"}]
)
def test_other_arms_lift(options: dict[str, str]) -> None:
    episode = record(get_task("lift"), 0, **options)
    assert episode.extras["successes"].any()
    kwargs = episode.attributes["env_args"]["env_kwargs"]
    assert (kwargs["skills"], kwargs["robots"]) == (["lift"], options["robot"])


def test_panda_carries_a_lifted_cube_and_pushes_it_after_it_let_go() -> None:
    for name in ("lift-reach", "lift-push_left"):
        task = get_task(name).with_options(robot="Panda")
        assert record(task, 0).extras["stages"][-1] == 2


def test_robosuite_rebuilds_a_task_with_another_arm() -> None:
    import robosuite

    metadata = robosuite_metadata(Push("up"), "UR5e", "PandaGripper")
    env = robosuite.make(metadata["env_name"], **metadata["env_kwargs"])
    assert env.robot_names == ["UR5e"]
    assert env.skill == Push("up")
    assert type(env.robots[0].gripper["right"]).__name__ == "PandaGripper"
    env.close()


def test_torchrl_and_gymnasium_take_another_arm() -> None:
    env = gymnasium.make("bmrl/SawyerLift-v0", robot="Panda")
    assert env.unwrapped.robosuite_env.robot_names == ["Panda"]
    env.close()
    task = get_task("push_up").with_options(robot="Panda")
    assert task.make_env is not None
    for num_envs in (None, 2):
        made = task.make_env(num_envs=num_envs, **task.options)
        check_env_specs(made, seed=0)
        made.close()


def test_a_state_of_another_arm_is_restored_exactly() -> None:
    env = TabletopEnv("lift", robot="Panda")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(rng.uniform(-1, 1, 7))
    state, actions = env.get_state(), rng.uniform(-1, 1, (5, 7))
    first = [env.step(action)[0]["robot0_joint_pos"] for action in actions]
    env.set_state(state)
    again = [env.step(action)[0]["robot0_joint_pos"] for action in actions]
    np.testing.assert_array_equal(first, again)
    env.close()


def test_an_unknown_arm_is_answered_with_the_valid_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"robot 'Pandar'.*Sawyer, Panda"):
        TabletopEnv("lift", robot="Pandar")
    lift, reach = get_task("lift"), get_task("reach").with_options(robot="Panda")
    with pytest.raises(ConfigError, match="Panda, Sawyer; valid: the same arm"):
        compose_tasks([lift, reach])


# -- values ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*SKILLS, "reach-lift-push_left"])
def test_a_task_is_the_same_after_pickling(name: str) -> None:
    task = get_task(name)
    again = pickle.loads(pickle.dumps(task))
    assert again.options == task.options
    assert again.record.func is task.record.func
    assert again.record.keywords == task.record.keywords


@pytest.mark.parametrize("skill", SKILLS.values())
def test_a_skill_is_rebuilt_from_its_pickle_and_from_its_description(skill: Any) -> None:
    assert pickle.loads(pickle.dumps(skill)) == skill
    assert make_skills([describe_skill(skill)]) == (skill,)


def test_a_description_of_something_else_is_refused() -> None:
    with pytest.raises(BMRLError, match="is not a Skill"):
        make_skills({"skill": "torchrl_bmrl.envs.skills:reach_reward"})


def _without_registry(task: Any) -> tuple[int, int]:
    from torchrl_bmrl import tasks

    tasks._registry.clear()
    episode = task.record(0, noise=0.2, **task.options)
    return len(episode), len(tasks._registry)


def test_a_spawned_worker_needs_no_registry() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(_without_registry, (get_task("reach-lift"),)) == (200, 0)
