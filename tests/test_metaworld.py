"""Families of ML1: what a task fixes, what it hides, and what its demonstrations are."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("metaworld", exc_type=ImportError)
pytest.importorskip("h5py")

import metaworld
from metaworld import policies

from torchrl_bmrl.envs.metaworld import MetaWorldEnv, make_metaworld_env
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.experts.metaworld import (
    SPACES,
    _draw_in,
    make_ml1_family,
    make_ml1_task,
    record_ml1_episode,
)
from torchrl_bmrl.families import get_family, tasks_of
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.tasks import get_task

pytestmark = pytest.mark.metaworld

NAMES = ("ml1_reach", "ml1_push", "ml1_pick_place", "ml1_drawer_close", "ml1_button_press")
SEEN = ("ml1_drawer_close", "ml1_button_press")
"""Families whose object lies where the goal is."""
MODULE = "torchrl_bmrl.experts.metaworld"


def made(name: str, **options: Any) -> MetaWorldEnv:
    """The environment of a member."""
    return MetaWorldEnv(**{**get_task(name).options, **options})


def goal(env: MetaWorldEnv) -> np.ndarray:
    return env.observation_with_goal()[-3:]


def play(env: MetaWorldEnv, actions: np.ndarray) -> dict[str, np.ndarray]:
    observations, rewards = [env.reset()[0]], []
    for action in actions:
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    return {"observation": np.stack(observations), "reward": np.array(rewards)}


def some_actions(steps: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (steps, 4)).astype(np.float32)


# -- members ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_family_has_40_trained_and_10_other_held_out_goals(name: str) -> None:
    family = get_family(f"{MODULE}:{name}")
    trained, held_out = family.members["train"], family.members["inside"]
    assert (len(set(trained)), len(set(held_out)), family.members["outside"]) == (40, 10, [])
    assert not set(trained) & set(held_out)
    names = [task.name for split in ("train", "inside") for task in family.tasks(split)]
    assert names == [f"{name}_{number:02d}" for number in range(50)]
    assert tasks_of(f"{MODULE}:{name}") == family.tasks("train")
    for task, parameter in zip(family.tasks("train"), trained, strict=True):
        assert family.parameter(task.name) == parameter
        assert all(abs(number) < 1 + 1e-9 for number in family.told(task.name))


@pytest.mark.parametrize("env", SPACES)
def test_goals_are_draws_that_meta_world_itself_accepts(env: str) -> None:
    """With the bounds that it has."""
    space = make_metaworld_env(env)._random_reset_space
    assert SPACES[env].low == tuple(space.low.tolist())
    assert SPACES[env].high == tuple(space.high.tolist())
    family = make_ml1_family(env)
    _, drawn = _draw_in(env, np.random.default_rng(derive_seed(0, "ml1", env)), 50)
    tasks = [*family.tasks("train"), *family.tasks("inside")]
    assert [task.options["rand_vec"] for task in tasks] == drawn


def test_the_first_goals_stay_what_they_are() -> None:
    """Results and demonstrations of other versions of this library are of the same tasks."""
    found = {name: get_task(f"{name}_00").options["rand_vec"] for name in NAMES}
    assert found == {
        "ml1_reach": (0.036911, 0.63668, 0.02, -0.059837, 0.86047, 0.283769),
        "ml1_push": (0.028729, 0.621114, 0.02, -0.096805, 0.842637, 0.015659),
        "ml1_pick_place": (-0.075622, 0.690402, 0.02, -0.086451, 0.875504, 0.108746),
        "ml1_drawer_close": (0.020428, 0.9, 0.0),
        "ml1_button_press": (-0.082957, 0.89151, 0.115),
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_members_parameter_is_where_the_goal_lies(name: str) -> None:
    family = get_family(name)
    for task in family.tasks("train")[:3]:
        env = made(task.name)
        env.reset()
        axes = ["xyz".index(number.split()[1]) for number in family.parameters]
        # The button's goal lies at its front, the parameter is its centre.
        shift = np.array([0, 0.5, 0]) if name == "ml1_button_press" else np.zeros(3)
        distance = np.abs(goal(env)[axes] - family.parameter(task.name))
        assert (distance <= 1e-9 + shift[axes]).all()


def test_any_other_environment_of_meta_world_becomes_a_family() -> None:
    family = make_ml1_family("door-open-v3")
    assert family.name == "ml1_door_open"
    first, second = family.tasks("train")[:2]
    assert first.options["rand_vec"] != second.options["rand_vec"]
    episode = first.record(0, noise=0.0, **first.options)
    assert episode.succeeded


@pytest.mark.slow
def test_importing_the_module_imports_neither_meta_world_nor_robosuite() -> None:
    code = f"import sys, {MODULE}; sys.exit(bool({{'metaworld', 'robosuite'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# -- what a task fixes and hides -------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_task_fixes_goal_and_start_over_episodes_and_seeds(name: str) -> None:
    env, again = made(f"{name}_00"), made(f"{name}_00")
    starts, goals = [], []
    for seed in (None, 0, 1, 2**32 - 1):
        starts.append(env.reset(seed=seed)[0])
        goals.append(goal(env))
        for action in some_actions(20):
            env.step(action)
    starts.append(again.reset(seed=7)[0])
    goals.append(goal(again))
    assert all(np.array_equal(start, starts[0]) for start in starts)
    assert all(np.array_equal(each, goals[0]) for each in goals)


@pytest.mark.parametrize("name", NAMES)
def test_goals_differ_between_tasks(name: str) -> None:
    goals = []
    for number in range(50):
        env = made(f"{name}_{number:02d}")
        env.reset()
        goals.append(tuple(goal(env)))
        env.close()
    assert len(set(goals)) == 50


@pytest.mark.parametrize("env", ["reach-v3", "push-v3", "pick-place-v3"])
def test_observations_of_two_goals_are_equal_and_rewards_are_not(env: str) -> None:
    start = (0.05, 0.65, 0.02)
    low, high = ((*start, *corner) for corner in (SPACES[env].low[3:], SPACES[env].high[3:]))
    actions = record_ml1_episode(0, env=env, rand_vec=low, horizon=150, noise=0.1).actions
    one, other = (play(MetaWorldEnv(env, rand_vec), actions) for rand_vec in (low, high))
    assert np.array_equal(one["observation"], other["observation"])
    assert np.abs(one["reward"] - other["reward"]).max() > 1


@pytest.mark.parametrize("name", NAMES)
def test_the_goal_reads_as_zero_in_every_step(name: str) -> None:
    """The numbers before it are those of the step before, without a goal either."""
    observation = play(made(f"{name}_03"), some_actions(50))["observation"]
    assert observation.shape == (51, 39)
    assert not observation[:, -3:].any()
    assert np.array_equal(observation[1:, 18:36], observation[:-1, :18])


@pytest.mark.parametrize("name", SEEN)
def test_an_object_that_is_the_goal_is_seen(name: str) -> None:
    for task in get_family(name).tasks("train")[:5]:
        observation, _ = made(task.name).reset()
        assert observation[4] == pytest.approx(task.options["rand_vec"][0], abs=1e-6)


def test_a_task_plays_as_in_meta_worlds_own_benchmark() -> None:
    benchmark = metaworld.ML1("push-v3", seed=1)
    theirs = benchmark.train_classes["push-v3"]()
    theirs.set_task(benchmark.train_tasks[0])
    start, _ = theirs.reset()
    ours, actions = MetaWorldEnv("push-v3", theirs._last_rand_vec), some_actions(100)
    steps = [theirs.step(action) for action in actions]
    played = play(ours, actions)
    expected = np.stack([start, *(step[0] for step in steps)]).astype(np.float32)
    assert np.array_equal(played["observation"], expected)
    assert np.array_equal(played["reward"], [step[1] for step in steps])


# -- demonstrations --------------------------------------------------------------------------------


def record(name: str, seed: int, noise: float, **options: Any) -> Any:
    task = get_task(name)
    return task.record(seed, noise=noise, **{**task.options, **options})


def test_a_seed_reproduces_an_episode_to_the_bit_and_other_seeds_have_other_noise() -> None:
    one, again, other = (record("ml1_push_00", seed, 0.2, horizon=150) for seed in (3, 3, 4))
    for part in ("actions", "rewards"):
        assert np.array_equal(getattr(one, part), getattr(again, part))
        assert not np.array_equal(getattr(one, part), getattr(other, part))
    assert np.array_equal(one.observations["observation"], again.observations["observation"])
    first = [episode.observations["observation"][0] for episode in (one, other)]
    assert np.array_equal(*first)


def test_episodes_of_a_task_are_equal_without_noise() -> None:
    one, other = (record("ml1_pick_place_01", seed, 0.0, horizon=100) for seed in (0, 1))
    assert np.array_equal(one.actions, other.actions)
    assert np.array_equal(one.observations["observation"], other.observations["observation"])


def test_the_policy_of_another_task_goes_to_that_tasks_goal() -> None:
    other = get_task("ml1_reach_01")
    episode = record("ml1_reach_00", 0, 0.1, like=[other])
    assert episode.attributes["like"] == "ml1_reach_01"
    env = made("ml1_reach_01")
    env.reset()
    hand = episode.next_observations["observation"][-1, :3]
    assert np.linalg.norm(hand - goal(env)) < 0.08
    env = made("ml1_reach_00")
    env.reset()
    assert np.linalg.norm(hand - goal(env)) > 0.08


class Still:
    """A scripted policy that does nothing."""

    def get_action(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros(4)


def test_the_noise_is_gaussian_of_the_given_standard_deviation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(policies.ENV_POLICY_MAP, "reach-v3", Still)
    actions = record("ml1_reach_00", 0, 0.2).actions
    assert actions.std(axis=0) == pytest.approx(np.full(4, 0.2), rel=0.15)
    assert actions.mean(axis=0) == pytest.approx(np.zeros(4), abs=0.03)
    assert np.abs(actions).max() < 1
    wide = record("ml1_reach_00", 0, 1.0).actions
    assert np.abs(wide).max() == 1
    assert (np.abs(wide) == 1).mean() == pytest.approx(0.317, abs=0.04)


def test_stored_actions_give_the_stored_episode_in_the_torchrl_environment() -> None:
    episode = record("ml1_drawer_close_05", 0, 0.1, horizon=120)
    assert episode.actions.dtype == np.float32
    assert np.abs(episode.actions).max() <= 1
    env = make_env("ml1_drawer_close_05", num_envs=2, horizon=120)
    actions = iter(torch.as_tensor(episode.actions).unsqueeze(1).expand(-1, 2, -1))
    data = env.rollout(120, lambda tensordict: tensordict.set("action", next(actions)))
    for row in data:
        assert row["observation"].dtype == torch.float32
        assert np.array_equal(row["observation"], episode.observations["observation"])
        after = row["next"]
        assert np.array_equal(after["observation"], episode.next_observations["observation"])
        assert np.array_equal(after["reward"].squeeze(-1), episode.rewards.astype(np.float32))
        assert np.array_equal(after["success"].squeeze(-1), episode.extras["successes"])
        assert episode.succeeded
        assert after["truncated"].squeeze(-1).tolist() == [False] * 119 + [True]
        assert not after["terminated"].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_scripted_policy_solves_nine_in_ten_tasks(name: str) -> None:
    tasks = [*get_family(name).tasks("train")[::4], *get_family(name).tasks("inside")]
    solved = [task.record(0, noise=0.1, **task.options).succeeded for task in tasks]
    assert np.mean(solved) >= 0.9


@pytest.mark.slow
def test_the_pipeline_takes_members_by_name(tmp_path: Any) -> None:
    pytest.importorskip("safetensors")
    pytest.importorskip("tqdm")
    pytest.importorskip("yaml")
    from torchrl_bmrl.pipeline import BCQSettings, EvaluateSettings, Run, Settings, collect, stage1

    names = [f"{MODULE}:ml1_push_{number:02d}" for number in range(2)]
    settings = Settings(
        run_dir=str(tmp_path),
        tasks={name.rpartition(":")[2]: {"task": name, "horizon": 20} for name in names},
        workers=1,
        bcq=BCQSettings(epochs=1, updates_per_epoch=5, eval_episodes=2),
        evaluate=EvaluateSettings(episodes=2),
    )
    settings.collect.train_episodes = {"default": 1}
    settings.collect.valid_episodes = 1
    with Run(settings) as run:
        collect(run)
        stage1(run)
        assert run.transitions("ml1_push_01", "valid")["observation"].shape == (20, 39)


@pytest.mark.slow
@pytest.mark.robosuite
def test_robosuite_plays_the_same_before_and_after_meta_world() -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    reach = get_task("reach").with_options(horizon=30)

    def both() -> list[Any]:
        ours = reach.record(0, noise=0.1, **reach.options)
        return [ours.rewards, record("ml1_reach_00", 0, 0.1, horizon=30).rewards]

    for one, again in zip(both(), both(), strict=True):
        assert np.array_equal(one, again)


# -- mistakes --------------------------------------------------------------------------------------


def test_mistakes_are_this_librarys_errors() -> None:
    drawer = get_task("ml1_drawer_close_00")
    with pytest.raises(UnknownNameError, match="'push-v2'; valid environment"):
        MetaWorldEnv("push-v2", (0.0, 0.9, 0.0))
    with pytest.raises(UnknownNameError, match="push-v2"):
        make_ml1_family("push-v2")
    for horizon in (0, 501, 2.5):
        with pytest.raises(ConfigError, match="a whole number from 1 to 500"):
            made("ml1_drawer_close_00", horizon=horizon)
    for rand_vec in ((0.0, 0.9), (0.2, 0.9, 0.0), (float("nan"), 0.9, 0.0)):
        with pytest.raises(ConfigError, match=r"numbers between \(-0.1, 0.9, 0.0\)"):
            made("ml1_drawer_close_00", rand_vec=rand_vec)
    with pytest.raises(ConfigError, match="farther apart"):
        MetaWorldEnv("push-v3", (0.0, 0.7, 0.02, 0.0, 0.8, 0.02))
    with pytest.raises(ConfigError, match="gains of drawer-close-v3"):
        record(drawer.name, 0, 0.1, gains=ExpertGains(speed_limit=0.5))
    with pytest.raises(ConfigError, match="nothing before a task"):
        record(drawer.name, 0, 0.1, after=(drawer,))
    with pytest.raises(ConfigError, match="tasks of drawer-close-v3"):
        record(drawer.name, 0, 0.1, like=[get_task("ml1_push_00")])
    with pytest.raises(ConfigError, match="cannot follow each other"):
        get_task("ml1_drawer_close_00-ml1_drawer_close_01")
    with pytest.raises(ConfigError, match="no member has the parameter"):
        get_family("ml1_push").make(0.0, 0.0)
    with pytest.raises(UnknownNameError, match="ml1_push_50"):
        get_task("ml1_push_50")


def test_default_gains_are_taken_since_runs_pass_them() -> None:
    episode = record("ml1_drawer_close_00", 0, 0.1, gains=ExpertGains(), horizon=5)
    assert len(episode) == 5


def test_a_goal_of_your_own_is_a_task() -> None:
    task = make_ml1_task("middle", "drawer-close-v3", (0.0, 0.9, 0.0))
    episode = replace(task, title="Middle").record(0, noise=0.1, **task.options)
    assert episode.succeeded
    assert record_ml1_episode(0, noise=0.1, **task.options).rewards.sum() == episode.rewards.sum()
