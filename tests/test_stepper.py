"""The fast step is robosuite's own, to the bit; what it does not cover is left to robosuite."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import mujoco
from robosuite.controllers import load_composite_controller_config

from torchrl_bmrl.envs import tabletop
from torchrl_bmrl.envs.lean import without_pictures
from torchrl_bmrl.envs.obstacles import why_not_fast
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.envs.skills import SKILLS
from torchrl_bmrl.envs.stepper import FastStepper
from torchrl_bmrl.envs.tabletop import STEPPERS, TabletopEnv
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.experts.controllers import make_expert

pytestmark = pytest.mark.robosuite

Act = Callable[[], np.ndarray]


def random_actions(env: TabletopEnv, seed: int) -> Act:
    rng = np.random.default_rng(seed)
    return lambda: rng.uniform(-1, 1, 7)


def zero_actions(env: TabletopEnv, seed: int) -> Act:
    return lambda: np.zeros(7)


def held_saturated_actions(env: TabletopEnv, seed: int) -> Act:
    """Full speed one way: into the table, the joints' limits and singular poses."""
    action = np.sign(np.random.default_rng(seed + 7).standard_normal(7))
    return lambda: action


def switching_saturated_actions(env: TabletopEnv, seed: int) -> Act:
    rng = np.random.default_rng(seed)
    return lambda: np.sign(rng.standard_normal(7))


def expert_actions(env: TabletopEnv, seed: int) -> Act:
    expert, rng = make_expert(env.robosuite_env), np.random.default_rng(seed)
    return lambda: np.clip(expert() + 0.2 * rng.standard_normal(7), -1, 1)


ACTIONS = [
    random_actions,
    zero_actions,
    held_saturated_actions,
    switching_saturated_actions,
    expert_actions,
]


@pytest.fixture(scope="module")
def pairs() -> Iterator[Callable[[str], tuple[TabletopEnv, TabletopEnv]]]:
    """robosuite's own model and step, and the fast one's, of a task."""
    made: dict[str, tuple[TabletopEnv, TabletopEnv]] = {}

    def pair(task: str) -> tuple[TabletopEnv, TabletopEnv]:
        if task not in made:
            made[task] = TabletopEnv(task, stepper="robosuite"), TabletopEnv(task)
        return made[task]

    yield pair
    for envs in made.values():
        for env in envs:
            env.close()


def everything(env: TabletopEnv) -> list[np.ndarray]:
    """What MuJoCo holds of the state and of what follows from it."""
    data = env.robosuite_env.sim.data._data
    names = ("qpos", "qvel", "qacc", "ctrl", "qfrc_bias", "site_xpos", "site_xmat", "xpos")
    return [np.array(getattr(data, name)) for name in names] + [np.array([data.time, data.ncon])]


def assert_same_steps(reference: TabletopEnv, env: TabletopEnv, act: Act, steps: int) -> None:
    start = everything(reference)
    for _ in range(steps):
        action = act()
        theirs, ours = reference.step(action), env.step(action)
        for name, part in theirs[0].items():
            np.testing.assert_array_equal(ours[0][name], part)
        assert ours[1:] == theirs[1:]
        for now, then in zip(everything(env), everything(reference), strict=True):
            np.testing.assert_array_equal(now, then)
    assert not np.array_equal(everything(reference)[0], start[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("actions", ACTIONS, ids=lambda actions: actions.__name__)
@pytest.mark.parametrize("task", SKILLS)
def test_every_number_of_an_episode_equals_robosuites(
    pairs: Any, task: str, actions: Callable[..., Act], seed: int
) -> None:
    reference, env = pairs(task)
    for one in (reference, env):
        one.reset(seed=seed)
    assert_same_steps(reference, env, actions(reference, seed), 200)
    assert env._fast is not None
    assert reference._fast is None


def test_a_few_steps_of_each_task_equal_robosuites(pairs: Any) -> None:
    for task in ("reach", "lift", "push_down"):
        reference, env = pairs(task)
        for one in (reference, env):
            one.reset(seed=3)
        assert_same_steps(reference, env, random_actions(env, 3), 10)


def test_where_numpys_blas_cannot_be_called_numpy_multiplies(
    pairs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchrl_bmrl.envs.stepper.NUMPYS_DGEMV", 0)
    reference, env = pairs("reach")
    env._fast = None
    for one in (reference, env):
        one.reset(seed=4)
    assert_same_steps(reference, env, random_actions(env, 4), 10)
    assert env._fast is not None
    assert not env._fast._robot.direct
    env._fast = None  # the others call BLAS


def test_fast_and_stock_steps_can_take_turns(pairs: Any) -> None:
    reference, env = pairs("lift")
    for one in (reference, env):
        one.reset(seed=2)
    act = expert_actions(reference, 2)
    fast = FastStepper(env.robosuite_env)
    for step in range(40):
        action = act()
        reference.step(action)
        if step % 3:
            fast.step(action)
        else:
            env.robosuite_env.step(action)
        for now, then in zip(everything(env), everything(reference), strict=True):
            np.testing.assert_array_equal(now, then)


def test_reset_of_the_robosuite_environment_itself_is_noticed(pairs: Any) -> None:
    reference, env = pairs("reach")
    for one in (reference, env):
        one.reset(seed=0)
        one.step(np.ones(7))
        one.robosuite_env.reset()
    assert_same_steps(reference, env, random_actions(env, 0), 5)


# -- controllers -----------------------------------------------------------------------------------


def made_with(changes: dict[str, Any]) -> list[TabletopEnv]:
    """A fast and a stock environment, reset, with another configuration of the arm's controller."""
    config = load_composite_controller_config(robot="Sawyer")
    config["body_parts"]["right"].update(changes)
    envs = [TabletopEnv("lift", stepper=name, controller_configs=config) for name in STEPPERS]
    for env in envs:
        env.reset(seed=1)
        env.action_space.seed(1)
    return envs


COVERED = {
    "world frame": {"input_ref_frame": "world"},
    "variable stiffness": {"impedance_mode": "variable_kp"},
    "variable impedance": {"impedance_mode": "variable"},
    "position only": {
        "type": "OSC_POSITION",
        "output_max": [0.05] * 3,
        "output_min": [-0.05] * 3,
    },
    "absolute poses": {"input_type": "absolute"},
    "the controller evaluates the physics again": {"lite_physics": False},
    "stiffer": {"kp": [100, 200, 300, 100, 200, 300], "damping_ratio": 0.7},
    "commands beyond the fingers' limits": {
        "gripper": {"type": "GRIP", "use_action_scaling": False}
    },
}
NOT_COVERED = {
    "JointPositionController": {"type": "JOINT_POSITION", "output_max": 0.05, "output_min": -0.05},
    "interpolate": {"interpolation": "linear"},
    "uncoupled": {"uncouple_pos_ori": False},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COVERED)
def test_other_operational_space_controllers_are_covered(name: str) -> None:
    fast, reference = made_with(COVERED[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same_steps(reference, fast, fast.action_space.sample, 30)
    assert fast._fast is not None
    for env in (fast, reference):
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("reason", NOT_COVERED)
def test_a_controller_that_is_not_covered_takes_robosuites_step_and_says_so_once(
    reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tabletop, "_warned", set())
    fast, reference = made_with(NOT_COVERED[reason])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert_same_steps(reference, fast, fast.action_space.sample, 5)
        fast.reset(seed=2)
        fast.step(fast.action_space.sample())
    assert [reason in str(warning.message) for warning in caught] == [True]
    assert "slow steps with robosuite's own code" in str(caught[0].message)
    with pytest.raises(BMRLError, match=reason):
        FastStepper(fast.robosuite_env)
    for env in (fast, reference):
        env.close()


CHANGES = {
    "frame": lambda env, arm: setattr(arm, "input_ref_frame", "world"),
    "physics": lambda env, arm: setattr(env, "lite_physics", False),
    "physics of the controller": lambda env, arm: setattr(arm, "lite_physics", False),
    "stiffness": lambda env, arm: setattr(arm, "kp", arm.kp * 0.5),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_setting_that_changes_within_an_episode_is_followed(name: str) -> None:
    fast, reference = made_with({})
    act = random_actions(fast, 0)
    assert_same_steps(reference, fast, act, 2)
    before = everything(fast)
    for env in (fast, reference):
        scene = env.robosuite_env
        CHANGES[name](scene, scene.robots[0].composite_controller.part_controllers["right"])
    assert_same_steps(reference, fast, act, 3)
    assert not np.array_equal(everything(fast)[0], before[0])
    assert fast._fast is not None
    for env in (fast, reference):
        env.close()


def test_an_arm_that_is_no_chain_from_a_fixed_base_is_refused() -> None:
    scene = TabletopScene("reach")
    parents = scene.sim.model._model.dof_parentid
    arm = scene.robots[0].composite_controller.part_controllers["right"]
    assert why_not_fast(scene) is None
    parents[arm.qvel_index[3]] = arm.qvel_index[0]  # a joint beside the others
    obstacle = why_not_fast(scene)
    assert obstacle is not None
    assert obstacle.kind == "joints"
    with pytest.raises(BMRLError, match="not a chain"):
        FastStepper(scene)
    scene.close()


def test_an_unknown_stepper_is_answered_with_the_valid_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"'numpy'.*fast, robosuite"):
        TabletopEnv("lift", stepper="numpy")


# -- the lean model --------------------------------------------------------------------------------


def test_the_lean_model_has_a_thousandth_of_the_size_and_all_that_collides() -> None:
    env = TabletopScene("lift")
    full = mujoco.MjModel.from_xml_string(env.scene_xml())
    lean = mujoco.MjModel.from_xml_string(without_pictures(env.scene_xml()))
    env.close()
    assert lean.nbuffer < full.nbuffer / 500
    collides = (full.geom_contype != 0) | (full.geom_conaffinity != 0)
    assert lean.ngeom == collides.sum()
    assert [lean.geom(i).name for i in range(lean.ngeom)] == [
        full.geom(int(i)).name for i in np.flatnonzero(collides)
    ]
    np.testing.assert_array_equal(lean.body_mass, full.body_mass)
    np.testing.assert_array_equal(lean.body_inertia, full.body_inertia)


def test_room_for_contacts_is_far_more_than_an_episode_takes(pairs: Any) -> None:
    _, env = pairs("lift")
    env.reset(seed=0)
    act = held_saturated_actions(env, 1)
    for _ in range(100):
        env.step(act())
    data = env.robosuite_env.sim.data._data
    assert 0 < data.maxuse_arena < data.narena / 50


@pytest.mark.parametrize("task", ["reach", "push_up"])
def test_the_scenes_xml_is_complete_and_shows_this_episodes_goal(pairs: Any, task: str) -> None:
    reference, env = pairs(task)
    for one in (reference, env):
        one.reset(seed=4)
    xml = env.robosuite_env.scene_xml()
    assert xml == reference.robosuite_env.scene_xml()
    model = mujoco.MjModel.from_xml_string(xml)
    assert model.ngeom > 100
    np.testing.assert_array_equal(
        model.site("goal_marker").pos, env.robosuite_env.named_observation()["goal_pos"]
    )
