"""Scripted experts solve their tasks within their limits, and say which phase they are in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.envs.skills import SKILLS, Lift
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.experts.controllers import EXPERTS, ExpertGains, make_expert
from torchrl_bmrl.experts.tabletop import make_task

pytestmark = pytest.mark.robosuite

TASKS = tuple(SKILLS)

PHASES = {
    "reach": ("reach",),
    "lift": ("descend", "grasp", "lift"),
    **dict.fromkeys([t for t in TASKS if "push" in t], ("approach", "contact", "push")),
}


def act(
    env: TabletopEnv, seed: int, *, gains: ExpertGains | None = None, steps: int = 200
) -> tuple[np.ndarray, list[int], bool]:
    """Actions, phases and success of an expert without noise, up to its success."""
    env.reset(seed=seed)
    expert = make_expert(env.robosuite_env, gains)
    actions, phases = [], []
    for _ in range(steps):
        actions.append(expert())
        phases.append(expert.phase)
        *_, info = env.step(actions[-1].astype(np.float32))
        if info["success"]:
            return np.array(actions), phases, True
    return np.array(actions), phases, False


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("task", TASKS)
def test_an_expert_solves_its_task_phase_by_phase_within_the_action_space(
    envs: dict[str, TabletopEnv], task: str, seed: int
) -> None:
    actions, phases, solved = act(envs[task], seed)
    assert solved
    assert actions.shape[1] == 7
    assert np.abs(actions).max() <= 1.0
    names = make_expert(envs[task].robosuite_env).phases
    # Beyond these a push can let go of a cube that it finds in the hand.
    assert names[: len(PHASES[task])] == PHASES[task]
    # Without noise nothing is dropped or slips away: every phase once, in order.
    assert list(dict.fromkeys(phases)) == list(range(len(PHASES[task])))
    assert (np.diff(phases) >= 0).all()


def test_the_gripper_follows_the_phases(envs: dict[str, TabletopEnv]) -> None:
    actions, phases, _ = act(envs["lift"], 0)
    commands = {phase: set(actions[np.array(phases) == phase, 6]) for phase in (0, 1, 2)}
    assert commands[0] == {-1.0}
    assert commands[2] == {1.0}
    # The action that notices the start of the grasp still holds the fingers open.
    grasp = actions[np.array(phases) == 1, 6]
    assert (grasp[1:] == 1.0).all()
    assert (act(envs["push_up"], 0, steps=10)[0][:, 6] == 1.0).all()
    assert (act(envs["reach"], 0, steps=10)[0][:, 6] == -1.0).all()


def test_free_motion_respects_the_speed_limit(envs: dict[str, TabletopEnv]) -> None:
    for task in ("reach", "push_up"):
        actions, _, _ = act(envs[task], 2, gains=ExpertGains(speed_limit=0.3), steps=12)
        assert np.abs(actions[:, :3]).max() == pytest.approx(0.3)
        fast, _, _ = act(envs[task], 2, steps=12)
        assert np.abs(fast[:, :3]).max() > 0.9


def test_contact_has_a_speed_limit_of_its_own(envs: dict[str, TabletopEnv]) -> None:
    gains = ExpertGains(speed_limit=0.9, contact_speed_limit=0.4)
    actions, phases, _ = act(envs["push_up"], 0, gains=gains)
    pushing = np.array(phases) == 2
    assert pushing.any()
    assert np.abs(actions[pushing, :3]).max() == pytest.approx(0.4)
    assert np.abs(actions[~pushing, :3]).max() == pytest.approx(0.9)
    actions, phases, _ = act(envs["lift"], 0, gains=gains)
    descending = np.array(phases) == 0
    assert np.abs(actions[descending, :3]).max() == pytest.approx(0.4)
    assert np.abs(actions[~descending, :3]).max() == pytest.approx(0.9)


@pytest.mark.parametrize("task", ["lift", "push_left"])
def test_an_expert_starts_over_after_reset(envs: dict[str, TabletopEnv], task: str) -> None:
    env = envs[task]
    first, _, _ = act(env, 3, steps=40)
    env.reset(seed=4)
    expert = make_expert(env.robosuite_env)
    for _ in range(35):
        env.step(expert().astype(np.float32))
    assert expert.phase > 0
    env.reset(seed=3)
    expert.reset()
    assert expert.phase == 0
    again = []
    for _ in range(len(first)):
        again.append(expert())
        env.step(again[-1].astype(np.float32))
    np.testing.assert_array_equal(again, first)


@pytest.mark.parametrize("task", ["lift", "push_left"])
def test_an_expert_that_loses_the_cube_starts_over(envs: dict[str, TabletopEnv], task: str) -> None:
    scene = envs[task].robosuite_env
    envs[task].reset(seed=0)
    expert = make_expert(scene)
    while expert.phase < 2:
        envs[task].step(expert())
    place = scene.goal_start + np.array([0.08, 0.0, 0.0])  # beside the gripper
    scene.sim.data.set_joint_qpos(scene.cube.joints[0], np.append(place, [1.0, 0, 0, 0]))
    scene.sim.forward()
    expert()
    assert expert.phase == 0


def record(name: str, seed: int, *, horizon: int, **options: Any) -> Episode:
    task = make_task(SKILLS[name], EXPERTS[type(SKILLS[name])], horizon=horizon)
    return task.record(seed, **options, **task.options)  # type: ignore[misc]


def test_a_seed_reproduces_an_episode_with_its_noise() -> None:
    first, other, again = (record("lift", seed, horizon=25, noise=0.3) for seed in (5, 6, 5))
    for name in ("actions", "rewards"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for name in ("successes", "phases", "states"):
        np.testing.assert_array_equal(again.extras[name], first.extras[name])
    for name, part in first.observations.items():
        np.testing.assert_array_equal(again.observations[name], part)
    assert not np.array_equal(other.actions, first.actions)


def test_noise_is_gaussian_of_the_size_asked_for_on_every_dimension() -> None:
    # Slow, so that clipping to [-1, 1] leaves the noise as it was drawn.
    gains = ExpertGains(speed_limit=0.05)
    noisy = record("reach", 0, horizon=60, noise=0.2, gains=gains)
    assert noisy.actions.dtype == np.float32
    assert np.abs(noisy.actions).max() <= 1.0
    deviation = noisy.actions[:, :6].std(axis=0)
    assert (deviation > 0.12).all()
    assert (deviation < 0.3).all()
    assert noisy.actions[:, 6].std() > 0.05  # around -1, half of it clipped
    still = record("reach", 0, horizon=60, noise=0.0, gains=gains)
    assert np.abs(still.actions[:, :3]).max() <= 0.05 + 1e-6
    assert set(still.actions[:, 6]) == {-1.0}


def test_a_skill_without_an_expert_needs_one_to_be_given() -> None:
    class Raise(Lift):
        name = "raise"

    env = TabletopEnv(Raise())
    env.reset(seed=0)
    with pytest.raises(BMRLError, match="raise has no expert"):
        make_expert(env.robosuite_env)
    assert make_expert(env.robosuite_env, experts=[EXPERTS[Lift]]).phase == 0
    env.close()
