"""Saved states go on as if nothing had happened in between."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import torch

import torchrl_bmrl.envs  # registers the ids  # noqa: F401
from torchrl_bmrl.envs.tabletop import STEPPERS, TabletopEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import BMRLError

pytestmark = pytest.mark.robosuite

ACTIONS = np.random.default_rng(0).uniform(-1, 1, (60, 7))
ACTIONS[:, 2] -= 0.6  # down: fingers, cube and table touch
ACTIONS[:, 6] = np.sign(np.sin(np.arange(60)))  # the gripper is never at rest


def rows(env: TabletopEnv, actions: np.ndarray) -> np.ndarray:
    """Everything that steps show, and where they lead."""
    seen = []
    for action in actions:
        observation, reward, _, truncated, info = env.step(action)
        parts = np.concatenate([*observation.values()])
        data = env.robosuite_env.sim.data
        seen.append([reward, truncated, *parts, *map(float, info.values()), *data.qpos, *data.qvel])
    return np.array(seen)


@pytest.mark.parametrize("steps", [0, 1, 25])
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("task", ["reach", "lift", "push_left"])
def test_restoring_equals_never_having_left(task: str, stepper: str, steps: int) -> None:
    env, other = (TabletopEnv(task, stepper=stepper) for _ in range(2))
    env.reset(seed=1)
    rows(env, ACTIONS[:steps])
    state = env.get_state()
    stayed = rows(env, ACTIONS[steps : steps + 15])
    rows(env, -ACTIONS[:7])
    env.set_state(state)
    np.testing.assert_array_equal(rows(env, ACTIONS[steps : steps + 15]), stayed)
    other.reset(seed=9)  # and no step: robosuite's controller would not look at the arm again
    other.set_state(state)
    np.testing.assert_array_equal(rows(other, ACTIONS[steps : steps + 15]), stayed)
    for one in (env, other):
        one.close()


def test_a_state_comes_back_from_a_file_with_observation_time_limit_and_next_start(
    tmp_path: Path,
) -> None:
    env = TabletopEnv("push_left", horizon=12)
    env.reset(seed=5)
    for action in ACTIONS[:10]:
        observation, _, _, truncated, info = env.step(action)
        assert not truncated
    np.savez(tmp_path / "state.npz", **env.get_state())
    rest = [env.step(action) for action in ACTIONS[10:12]]
    following, _ = env.reset()
    fresh = TabletopEnv("push_left", horizon=12)
    with np.load(tmp_path / "state.npz") as state:
        shown, shown_info = fresh.reset(options={"state": state})
    for name, part in observation.items():
        np.testing.assert_array_equal(shown[name], part)
    assert shown_info["success"] == info["success"]
    again = [fresh.step(action) for action in ACTIONS[10:12]]
    assert [step[3] for step in again] == [step[3] for step in rest] == [False, True]
    np.testing.assert_array_equal(fresh.reset()[0]["goal_pos"], following["goal_pos"])
    for one in (env, fresh):
        one.close()


def test_a_state_of_one_task_goes_on_in_another_with_its_rewards(
    envs: dict[str, TabletopEnv],
) -> None:
    lift, push = envs["lift"], envs["push_left"]
    lift.reset(seed=2)
    rows(lift, ACTIONS[:8])
    push.reset(seed=3)
    push.set_state(lift.get_state())
    theirs, ours = (env.step(ACTIONS[8]) for env in (lift, push))
    for name, part in theirs[0].items():
        np.testing.assert_array_equal(ours[0][name], part)
    assert theirs[4]["reward_velocity"] == 0 < ours[4]["reward_velocity"]


BAD = {
    "missing": lambda state: state.pop("gripper"),
    "unknown": lambda state: state.update(colour=np.zeros(3)),
    "shape": lambda state: state.update(physics=state["physics"][:-1]),
    "kind": lambda state: state.update(steps=np.array([1.0])),
    "nan": lambda state: state.update(rest_joints=np.full(7, np.nan)),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_state_is_refused_and_changes_nothing(
    envs: dict[str, TabletopEnv], fault: str
) -> None:
    env = envs["lift"]
    env.reset(seed=0)
    state = env.get_state()
    rows(env, ACTIONS[:3])
    now = env.get_state()
    BAD[fault](state)
    name = {"missing": "gripper", "unknown": "colour", "shape": "physics", "kind": "steps"}
    with pytest.raises(BMRLError, match=name.get(fault, "rest_joints")):
        env.set_state(state)
    for key, part in env.get_state().items():
        np.testing.assert_array_equal(part, now[key])


def test_a_reach_state_does_not_fit_a_task_with_a_cube(envs: dict[str, TabletopEnv]) -> None:
    envs["reach"].reset(seed=0)
    with pytest.raises(BMRLError, match=r"physics.*lift"):
        envs["lift"].set_state(envs["reach"].get_state())


def test_torchrl_goes_on_from_a_state() -> None:
    env = make_env("lift")
    data = env.reset(seed=0)
    for action in ACTIONS[:4]:
        data = env.step(data.set("action", torch.tensor(action).float()))["next"]
    state = env.base_env.unwrapped.get_state()
    action = torch.tensor(ACTIONS[4]).float()
    stayed = env.step(data.clone().set("action", action))["next", "observation"]
    back = env.reset(options={"state": state})
    torch.testing.assert_close(back["observation"], data["observation"], rtol=0, atol=0)
    again = env.step(back.set("action", action))["next", "observation"]
    torch.testing.assert_close(again, stayed, rtol=0, atol=0)
    env.close()
