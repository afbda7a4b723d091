"""Episodes side by side are, to the bit, those that a single environment plays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import gymnasium
import torch
from torchrl.envs.utils import check_env_specs

import torchrl_bmrl.envs  # registers the ids  # noqa: F401
from torchrl_bmrl.envs.registration import gymnasium_id
from torchrl_bmrl.envs.skills import SKILLS
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.envs.vector import TabletopVectorEnv
from torchrl_bmrl.errors import BMRLError

pytestmark = pytest.mark.robosuite

ACTIONS = np.random.default_rng(0).uniform(-1, 1, (60, 7))
ACTIONS[:, 2] -= 0.6  # down: fingers, cube and table touch
ACTIONS[:, 6] = np.sign(np.sin(np.arange(60)))  # the gripper is never at rest


def test_each_episode_side_by_side_equals_the_one_alone() -> None:
    seeds = [7, 3, 11]
    vector, env = TabletopVectorEnv("lift", num_envs=3, horizon=20), TabletopEnv("lift", horizon=20)
    actions = np.stack([ACTIONS[:20], -ACTIONS[:20], ACTIONS[20:40]], 1)
    shown = [vector.reset(seed=seeds), *(vector.step(action) for action in actions)]
    for i, seed in enumerate(seeds):
        alone = [env.reset(seed=seed), *(env.step(action) for action in actions[:, i])]
        for theirs, ours in zip(shown, alone, strict=True):
            for name, part in ours[0].items():
                np.testing.assert_array_equal(theirs[0][name][i], part)
            assert {name: value[i] for name, value in theirs[-1].items()} == ours[-1]
            for several, single in zip(theirs[1:-1], ours[1:-1], strict=True):
                assert several[i] == single
    vector.close()
    env.close()


def test_some_episodes_start_anew_while_others_go_on() -> None:
    vector = TabletopVectorEnv("push_left", num_envs=3)
    before, _ = vector.reset(seed=0)
    again, _ = vector.reset(seed=0)
    np.testing.assert_array_equal(before["goal_pos"], again["goal_pos"])
    assert len(np.unique(before["goal_pos"].round(6), axis=0)) == 3
    observation, *_ = vector.step(np.stack([ACTIONS[0]] * 3))
    mask = np.array([False, True, False])
    after, info = vector.reset(seed=[20, 21, 22], options={"reset_mask": mask})
    for name, part in observation.items():
        np.testing.assert_array_equal(after[name][~mask], part[~mask])
    assert not np.array_equal(after["goal_pos"][1], observation["goal_pos"][1])
    assert (info["reward_reach"] > 0).tolist() == [True, False, True]  # a reset gives no reward
    states = vector.get_states()
    gone_on, *_ = vector.step(np.stack([ACTIONS[1]] * 3))
    vector.reset(options={"states": states})
    restored, *_ = vector.step(np.stack([ACTIONS[1]] * 3))
    for name, part in gone_on.items():
        np.testing.assert_array_equal(restored[name], part)
    vector.close()


def test_bad_calls_of_a_vector_environment_are_answered() -> None:
    with pytest.raises(BMRLError, match="num_envs is 0"):
        TabletopVectorEnv("reach", num_envs=0)
    vector = TabletopVectorEnv("reach", num_envs=2)
    with pytest.raises(BMRLError, match="call reset first"):
        vector.step(np.zeros((2, 7)))
    with pytest.raises(BMRLError, match="3 seeds for 2 environments"):
        vector.reset(seed=[1, 2, 3])
    with pytest.raises(BMRLError, match="have not started"):
        vector.reset(options={"reset_mask": np.array([True, False])})
    vector.reset(seed=0)
    before = vector.get_states()
    bad = np.zeros((2, 7))
    bad[1, 3] = np.nan
    for actions in (bad, np.zeros(7)):
        with pytest.raises(BMRLError, match=r"finite, \(2, 7\)"):
            vector.step(actions)
    broken = vector.get_states()
    del broken[1]["gripper"]
    vector.step(np.zeros((2, 7)))
    before = vector.get_states()
    with pytest.raises(BMRLError, match="gripper"):
        vector.reset(options={"states": broken})
    for state, then in zip(vector.get_states(), before, strict=True):
        np.testing.assert_array_equal(state["physics"], then["physics"])
    vector.close()


@pytest.mark.parametrize("task", SKILLS)
def test_torchrl_and_gymnasium_take_the_vector_environment(task: str) -> None:
    made = gymnasium.make_vec(gymnasium_id(task), num_envs=2)
    assert isinstance(made, TabletopVectorEnv)
    made.close()
    env = make_env(task, num_envs=2)
    assert env.batch_size == (2,)
    check_env_specs(env, seed=0)
    env.close()


def test_a_batch_in_torchrl_shows_what_single_environments_show() -> None:
    single, batch = make_env("push_left"), make_env("push_left", num_envs=2)
    actions = torch.tensor(ACTIONS[:6], dtype=torch.float32)

    def play(env: Any, data: Any, stack: Any) -> list[Any]:
        steps = []
        for action in actions:
            data = env.step(data.set("action", stack(action)))["next"]
            steps.append(data)
        return steps

    several = play(batch, batch.reset(seed=[4, 5]), lambda action: action.expand(2, 7))
    for i, seed in enumerate((4, 5)):
        alone = play(single, single.reset(seed=seed), lambda action: action)
        for theirs, ours in zip(several, alone, strict=True):
            assert theirs[i].keys() == ours.keys()
            for key, value in ours.items():
                torch.testing.assert_close(theirs[i][key], value, rtol=0, atol=0)
    for env in (single, batch):
        env.close()


def test_torchrl_starts_some_episodes_of_a_batch_anew() -> None:
    env = make_env("reach", num_envs=3, horizon=4)
    torch.manual_seed(0)
    data = env.rollout(10, break_when_any_done=False)
    env.close()
    assert data["next", "truncated"].squeeze(-1).sum(1).tolist() == [2, 2, 2]
    goals = data["observation"][..., -3:]
    assert [len(goals[i].unique(dim=0)) for i in range(3)] == [3, 3, 3]  # 4 + 4 + 2 steps
