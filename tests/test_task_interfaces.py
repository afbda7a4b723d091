"""The six tasks in Gymnasium, TorchRL and robosuite: names, observations, bad input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import gymnasium
import torch
from gymnasium.utils.env_checker import check_env
from observations import OBSERVATION_SHAPES
from scene_state import DIRECTIONS, TASKS, simulator
from torchrl.envs.utils import check_env_specs

import torchrl_bmrl.envs  # registers the ids  # noqa: F401
from torchrl_bmrl.envs.hidden import HIDDEN
from torchrl_bmrl.envs.registration import gymnasium_id
from torchrl_bmrl.envs.robosuite_names import robosuite_metadata
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.envs.skills import REWARD_TERMS
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import BMRLError, UnknownNameError

pytestmark = pytest.mark.robosuite

IDS = {
    "reach": "bmrl/SawyerReach-v0",
    "lift": "bmrl/SawyerLift-v0",
    "push_right": "bmrl/SawyerPushRight-v0",
    "push_left": "bmrl/SawyerPushLeft-v0",
    "push_up": "bmrl/SawyerPushUp-v0",
    "push_down": "bmrl/SawyerPushDown-v0",
}


def test_the_ids_are_those_of_the_tasks_and_one_for_compositions() -> None:
    assert {task: gymnasium_id(task) for task in TASKS} == IDS
    registered = {i for i in gymnasium.registry if i.startswith("bmrl/")}
    families = {gymnasium_id(family) for family in HIDDEN}
    assert registered == {*IDS.values(), "bmrl/SawyerComposition-v0", *families}
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
            name: (size,) for name, size in OBSERVATION_SHAPES.items()
        }
        assert env.observation_space.contains(observation)


@pytest.mark.parametrize("task", ["reach", "push_up"])
def test_parts_are_robosuites_observables_of_the_same_names(task: str) -> None:
    env = TabletopScene(task, seed=4)
    theirs, ours = env.reset(), env.named_observation()
    env.close()
    for name in OBSERVATION_SHAPES:
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
