"""Tasks that follow each other in one episode, the experts that do them, starts in between."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import torch

from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.envs.skills import Reach
from torchrl_bmrl.envs.table import CUBE_HALF_SIZE, HOVER_HEIGHT, TABLE_TOP
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.envs.vector import TabletopVectorEnv
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.experts.controllers import CLOSE, OPEN, ReachExpert, make_expert
from torchrl_bmrl.experts.tabletop import make_task
from torchrl_bmrl.tasks import get_task

pytestmark = pytest.mark.robosuite

CHAIN = "reach-lift-reach"


def play(env: TabletopEnv, steps: int, *, stage: int | None = None) -> list[dict[str, Any]]:
    """The composed expert's steps, until a stage begins."""
    expert = make_expert(env.robosuite_env)
    rows = []
    for _ in range(steps):
        observation, reward, *_, info = env.step(expert())
        rows.append({"observation": observation, "reward": reward, **info})
        if stage is not None and info["stage"] >= stage:
            return rows
    assert stage is None, f"stage {stage} was not reached"
    return rows


def lifted(task: str = "lift-reach", seed: int = 0) -> TabletopEnv:
    """An environment whose cube the expert has just lifted."""
    env = TabletopEnv(task, horizon=None)
    env.reset(seed=seed)
    play(env, 150, stage=1)
    return env


@pytest.mark.parametrize(
    "composition", [CHAIN, "lift-push_left", "reach-push_up-reach", "lift-push_down-reach-lift"]
)
def test_the_composed_expert_does_every_task_in_turn(composition: str) -> None:
    env = TabletopEnv(composition, horizon=None)
    env.reset(seed=1)
    rows = play(env, 300 * len(env.robosuite_env.skills), stage=len(env.robosuite_env.skills))
    stages = [int(row["stage"]) for row in rows]
    assert set(np.diff([0, *stages])) == {0, 1}
    assert [bool(row["success"]) for row in rows] == [False] * (len(rows) - 1) + [True]


def test_the_goal_follows_the_stage() -> None:
    env = TabletopEnv(CHAIN, horizon=None)
    observation, info = env.reset(seed=3)
    scene = env.robosuite_env
    assert info["stage"] == 0
    above = scene.cube_position + np.array([0, 0, HOVER_HEIGHT])
    np.testing.assert_allclose(observation["goal_pos"], above, atol=1e-6)
    rows = play(env, 100, stage=1)
    np.testing.assert_allclose(rows[-1]["observation"]["goal_pos"], scene.cube_position)
    rows = play(env, 100, stage=2)
    target = scene.targets[2]
    np.testing.assert_array_equal(rows[-1]["observation"]["goal_pos"], target)
    assert np.linalg.norm(target - scene.cube_position) > 0.02
    rows = play(env, 100, stage=3)
    assert np.linalg.norm(rows[-1]["observation"]["robot0_eef_pos"] - target) < 0.02


def test_rewards_are_those_of_the_task_at_hand() -> None:
    env = TabletopEnv(CHAIN, horizon=None)
    env.reset(seed=0)
    rows = play(env, 200)
    for row in rows:
        terms = {name: row[f"reward_{name}"] for name in ("reach", "grasp", "lift", "velocity")}
        assert row["reward"] == sum(terms.values())
        if row["stage"] != 1:
            assert terms["grasp"] == terms["lift"] == 0.0
    assert any(row["reward_grasp"] for row in rows if row["stage"] == 1)


def test_success_lasts_and_the_last_task_goes_on() -> None:
    env = TabletopEnv("reach-reach", horizon=None)
    env.reset(seed=0)
    play(env, 200, stage=2)
    away = np.array([0, 0, 1.0, 0, 0, 0, 0])
    infos = [env.step(away)[-1] for _ in range(15)]
    assert all(info["success"] and info["stage"] == 2 for info in infos)
    assert not env.robosuite_env.skill_success()
    np.testing.assert_array_equal(env.robosuite_env.goal, env.robosuite_env.targets[1])


def test_a_cube_that_falls_on_the_way_is_no_success() -> None:
    env = lifted()
    expert = ReachExpert(env.robosuite_env)
    assert env.robosuite_env.carrying
    for _ in range(150):
        action = expert()
        action[-1] = OPEN
        *_, info = env.step(action)
    assert np.linalg.norm(env.robosuite_env.eef_position - env.robosuite_env.goal) < 0.02
    assert info["stage"] == 1


def test_a_push_after_a_lift_brings_the_cube_to_the_table() -> None:
    env = lifted("lift-push_left")
    scene = env.robosuite_env
    assert scene.goal_start[2] == TABLE_TOP[2] + CUBE_HALF_SIZE
    for _ in range(40):  # carried along the direction: no push
        *_, info = env.step(np.array([0, 1.0, 0.15, 0, 0, 0, CLOSE]))
    assert scene.cube_displacement[1] > 0.07
    assert info["stage"] == 1
    env.reset(seed=0)
    play(env, 300, stage=2)
    assert scene.cube_displacement[2] < 0.035


def test_a_reach_holds_the_gripper_as_it_finds_it() -> None:
    assert ReachExpert(lifted().robosuite_env)()[-1] == CLOSE
    env = TabletopEnv("reach")
    env.reset(seed=0)
    assert ReachExpert(env.robosuite_env)()[-1] == OPEN


def test_an_episode_that_goes_on_from_a_state_equals_one_never_left() -> None:
    env, other = lifted(CHAIN.removeprefix("reach-")), TabletopEnv("lift-reach", horizon=None)
    other.reset(seed=9)
    state = env.get_state()
    assert state["stage"].tolist() == [1]
    other.set_state(state)
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 7)):
        here, there = env.step(action), other.step(action)
        assert here[1] == there[1]
        assert here[-1]["stage"] == there[-1]["stage"]
        for name, part in here[0].items():
            np.testing.assert_array_equal(part, there[0][name])


def test_episodes_side_by_side_keep_their_own_stages() -> None:
    vector = TabletopVectorEnv("reach-reach", num_envs=2)
    vector.reset(seed=[0, 1])
    alone = [TabletopEnv("reach-reach", horizon=None) for _ in range(2)]
    for seed, env in enumerate(alone):
        env.reset(seed=seed)
    expert = make_expert(alone[0].robosuite_env)
    stages = []
    for _ in range(60):
        actions = np.stack([expert(), np.zeros(7)])
        observation, *_, info = vector.step(actions)
        for i, env in enumerate(alone):
            expected, *_ = env.step(actions[i])
            np.testing.assert_array_equal(observation["goal_pos"][i], expected["goal_pos"])
        stages.append(info["stage"].tolist())
    assert stages[-1][0] > 0
    assert stages[-1][1] == 0


def test_both_steppers_give_the_same_stages() -> None:
    rows = []
    for stepper in ("fast", "robosuite"):
        env = TabletopEnv("reach-lift", horizon=None, stepper=stepper)
        env.reset(seed=2)
        rows.append(play(env, 60))
    assert rows[0][-1]["stage"] == 2
    for fast, slow in zip(*rows, strict=True):
        assert (fast["stage"], fast["reward"]) == (slow["stage"], slow["reward"])
        for name, part in fast["observation"].items():
            np.testing.assert_array_equal(part, slow["observation"][name])


def test_a_composition_lasts_100_steps_for_each_of_its_tasks() -> None:
    assert get_task("reach-lift").horizon == 200
    env = make_env("reach-lift")
    data = env.rollout(500, lambda td: td.set("action", torch.zeros(7)))
    assert len(data) == 200
    assert data["next", "truncated"].sum() == 1
    assert not data["next", "terminated"].any()
    assert data["stage"].shape == (200,)


def test_a_name_that_is_no_task_is_refused_with_the_valid_ones() -> None:
    with pytest.raises(UnknownNameError, match="'lfit'; valid tasks: reach, lift"):
        TabletopEnv("reach-lfit")
    with pytest.raises(BMRLError, match="no tasks"):
        TabletopScene([])


# -- demonstrations --------------------------------------------------------------------------------


def episode(task: str, seed: int, after: str = "") -> Any:
    chain = get_task(task)
    before = tuple(get_task(name) for name in after.split("-") if name)
    return chain.record(seed, noise=0.1, after=before, **chain.options)  # type: ignore[misc]


def test_an_episode_after_others_begins_where_they_ended() -> None:
    reach = episode("reach", 0, after="lift")
    assert len(reach) == 200
    assert reach.attributes["after"] == "lift"
    left, right = reach.observations["robot0_gripper_qpos"][0]
    assert left - right < 0.02  # around the cube; open it is 2.3 cm
    assert (reach.actions[:, -1] > 0).all()
    assert np.ptp(reach.observations["goal_pos"], axis=0).max() == 0.0  # its own goal
    assert not reach.extras["successes"][0]
    assert reach.extras["successes"].any()
    again = episode("reach", 0, after="lift")
    np.testing.assert_array_equal(reach.actions, again.actions)

    lift = episode("lift", 0, after="reach")
    offset = lift.observations["robot0_eef_pos"][0] - lift.observations["goal_pos"][0]
    assert 0 < np.linalg.norm(offset - [0, 0, HOVER_HEIGHT]) < 0.02
    assert np.abs(lift.observations["robot0_joint_vel"][0]).max() > 0.05  # on the move
    assert lift.extras["successes"].any()


def test_a_demonstration_of_a_composition_knows_its_stages() -> None:
    chain = episode(CHAIN, 0)
    assert len(chain) == 300
    stages = chain.extras["stages"]
    assert stages[0] == 0
    assert set(np.diff(stages)) == {0, 1}
    assert stages[-1] == 3
    first = np.flatnonzero(chain.extras["successes"])[0]
    assert stages[first + 1] == 3 > stages[first]
    # Phases of different experts have no names in common.
    assert "phases" not in chain.extras
    assert "phase_names" not in chain.attributes


def test_the_starts_of_a_task_are_taken_in_turn(tmp_path: Any) -> None:
    from torchrl_bmrl.data.robomimic import open_episodes

    (path,) = collect_demonstrations(
        tmp_path,
        [make_task(Reach(), ReachExpert, horizon=5)],
        {"reach": 2},
        valid_episodes=1,
        noise=0.1,
        seed=0,
        workers=1,
        after={"reach": ["", "reach"]},
    ).values()
    with open_episodes(path) as episodes:
        befores = [episodes[name].attributes.get("after", "") for name in episodes]
    assert befores == ["", "reach", ""]
