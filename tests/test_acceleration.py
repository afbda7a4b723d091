"""An accelerated robosuite environment returns what stock robosuite returns, to the bit."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

from robosuite.utils.observables import Observable, create_gaussian_noise_corrupter, sensor
from robosuite.wrappers import GymWrapper
from stock_robosuite import (
    Act,
    assert_same,
    assert_same_steps,
    both,
    controller,
    everything,
    make,
    random_actions,
)

from torchrl_bmrl.envs.acceleration import accelerate_robosuite

pytestmark = pytest.mark.robosuite

TASKS = ["Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "Wipe"]


def held_saturated_actions(env: Any, rng: np.random.Generator) -> Act:
    action = np.sign(rng.standard_normal(env.action_dim))
    return lambda: action


def switching_saturated_actions(env: Any, rng: np.random.Generator) -> Act:
    return lambda: np.sign(rng.standard_normal(env.action_dim))


def still_actions(env: Any, rng: np.random.Generator) -> Act:
    return lambda: np.zeros(env.action_dim)


ACTIONS = [random_actions, held_saturated_actions, switching_saturated_actions, still_actions]


def assert_same_episodes(reference: Any, env: Any, steps: int, actions: Any = ACTIONS) -> None:
    for number, kind in enumerate(actions):
        assert_same(env.reset(), reference.reset())
        act = kind(reference, np.random.default_rng(number))
        assert_same_steps(reference, env, act, steps)
    assert env.step.stepper is not None  # the fast step was used


@pytest.fixture
def no_warning() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        yield


@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize("hard_reset", [True, False])
def test_a_few_steps_after_hard_and_soft_resets_equal_stock(hard_reset: bool) -> None:
    assert_same_episodes(*both("Lift", "Panda", hard_reset=hard_reset), steps=6)


@pytest.mark.slow
@pytest.mark.parametrize("kernels", [None, "Nehalem"])
def test_steps_equal_stock_whatever_linear_algebra_kernels_the_processor_gets(
    kernels: str | None,
) -> None:
    # OpenBLAS chooses its kernels by the processor, or by this variable. They add in other orders.
    test = "test_a_few_steps_after_hard_and_soft_resets_equal_stock"
    env = {name: x for name, x in os.environ.items() if not name.startswith("OPENBLAS_")}
    env |= {"OPENBLAS_CORETYPE": kernels} if kernels else {}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    done = subprocess.run(
        [*command, f"{__file__}::{test}"], env=env, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize("robot", ["Panda", "Sawyer", "UR5e"])
@pytest.mark.parametrize("task", TASKS)
def test_episodes_of_stock_tasks_equal_stock(task: str, robot: str) -> None:
    assert_same_episodes(*both(task, robot), steps=40)


@pytest.mark.slow
@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize("robot", ["IIWA", "Kinova3", "Jaco", "XArm7"])
def test_other_arms_equal_stock(robot: str) -> None:
    """IIWA's controller has a frame that turns with the first joint."""
    assert_same_episodes(*both("Lift", robot), steps=25)


HONOURED = {
    "sparse reward": {"reward_shaping": False},
    "no object": {"use_object_obs": False},
    "10 Hz": {"control_freq": 10},
    "33 Hz": {"control_freq": 33},  # observables and actions drift apart
    "every substep": {"control_freq": 500},
    "physics of robosuite 1.4": {"lite_physics": False},
    "no gripper": {"gripper_types": None},
    "another gripper": {"gripper_types": "Robotiq85Gripper"},
    "no noise": {"initialization_noise": None},
    "world frame": controller(input_ref_frame="world"),
    "variable impedance": controller(impedance_mode="variable"),
}


@pytest.mark.slow
@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize("name", HONOURED)
def test_options_are_honoured(name: str) -> None:
    reference, env = both("Lift", "Panda", hard_reset=False, **HONOURED[name])
    if name == "no gripper":
        assert_same(env.reset(), reference.reset())
        for _ in range(10):
            action = np.full(env.action_dim, 0.5)
            theirs, ours = reference.step(action), env.step(action)
            assert_same(ours[0], theirs[0])
            np.testing.assert_array_equal(env.sim.data.qpos, reference.sim.data.qpos)
    else:
        assert_same_episodes(reference, env, 12, [random_actions, held_saturated_actions])


def test_an_episode_ends_at_the_horizon_and_goes_no_further() -> None:
    reference, env = both("Lift", "Panda", horizon=2, hard_reset=False)
    for one in (reference, env):
        one.reset()
        assert [one.step(np.zeros(7))[2] for _ in range(2)] == [False, True]
        with pytest.raises(ValueError, match="terminated episode"):
            one.step(np.zeros(7))
        one.ignore_done = True
        one.reset()
        assert [one.step(np.zeros(7))[2] for _ in range(3)] == [False] * 3


def noisy(env: Any) -> None:
    corrupter = create_gaussian_noise_corrupter(0.0, 0.1)
    env.modify_observable("cube_pos", "corrupter", corrupter)
    env.modify_observable("robot0_eef_pos", "corrupter", corrupter)


def delayed(env: Any) -> None:
    env.modify_observable("cube_pos", "delayer", lambda: 0.03 * np.random.random())


def filtered(env: Any) -> None:
    seen: list[Any] = []
    env.modify_observable(
        "cube_pos", "filter", lambda x: (seen.append(x), np.mean(seen, axis=0))[1]
    )


def sampled_often(env: Any) -> None:
    env.modify_observable("robot0_joint_pos", "sampling_rate", 130)


def sampled_rarely(env: Any) -> None:
    env.modify_observable("robot0_joint_pos", "sampling_rate", 7)


def disabled(env: Any) -> None:
    env.modify_observable("robot0_eef_pos", "enabled", False)
    env.modify_observable("cube_quat", "active", False)


def counted(env: Any) -> None:
    class Counter(Observable):
        """An observable that is updated in every substep."""

        def update(self, timestep: float, obs_cache: Any, force: bool = False) -> None:
            self._current_observed_value = self._current_observed_value + env.sim.data.qvel[0]

    @sensor(modality="object")
    def nothing(obs_cache: Any) -> np.ndarray:
        return np.zeros(3)

    env.add_observable(Counter("counter", nothing))


CHANGES = [noisy, delayed, filtered, sampled_often, sampled_rarely, disabled, counted]


@pytest.mark.slow
@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_observables_are_sampled_in_stocks_substeps(change: Callable[[Any], None]) -> None:
    seen = []
    for env in both("Lift", "Panda", hard_reset=False):
        np.random.seed(3)
        change(env)
        env.reset()
        rng = np.random.default_rng(0)
        seen.append([(env.step(rng.uniform(-1, 1, 7))[0], everything(env)) for _ in range(12)])
    for (theirs, their_rest), (ours, our_rest) in zip(*seen, strict=True):
        assert_same(ours, theirs)
        assert_same(our_rest, their_rest)


def test_wrappers_may_be_around_it() -> None:
    stock = GymWrapper(make("Lift", "Panda", hard_reset=False))
    env = accelerate_robosuite(GymWrapper(make("Lift", "Panda", hard_reset=False)))
    assert isinstance(env, GymWrapper)
    for one in (stock, env):
        one.reset()
    np.testing.assert_array_equal(env.step(np.ones(7))[0], stock.step(np.ones(7))[0])
    assert env.env.step.stepper is not None


def test_changes_that_are_covered_are_followed_within_an_episode() -> None:
    reference, env = both("Lift", "Panda", hard_reset=False)
    act = random_actions(env, np.random.default_rng(0))
    for one in (reference, env):
        one.reset()
    assert_same_steps(reference, env, act, 2)
    for one in (reference, env):
        arm = one.robots[0].composite_controller.part_controllers["right"]
        arm.kp, arm.input_ref_frame = arm.kp * 0.5, "world"
        one.sim.model.body_mass[5] *= 2
        one.sim.model.actuator_ctrlrange[:3] *= 0.01
        one.lite_physics = False
    assert_same_steps(reference, env, act, 3)
    for one in (reference, env):
        one.lite_physics = True
        one.robots[0].set_robot_joint_positions(one.robots[0].init_qpos + 0.1)
    assert_same_steps(reference, env, act, 3)
    for one in (reference, env):
        one.reset_from_xml_string(one.model.get_xml())
    assert_same_steps(reference, env, act, 3)
    assert env.step.stepper is not None
    del env.step
    assert_same_steps(reference, env, act, 2)


def test_an_action_of_another_length_is_refused_as_by_stock() -> None:
    reference, env = both("Lift", "Panda", hard_reset=False)
    for one in (reference, env):
        one.reset()
        one.step(np.ones(7))
        with pytest.raises(AssertionError, match="invalid action dimension -- expected 7, got 6"):
            one.step(np.ones(6))
    assert_same_steps(reference, env, lambda: np.ones(7), 2)
