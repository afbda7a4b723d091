"""An accelerated robosuite environment returns what stock robosuite returns, to the bit."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import robosuite
from robosuite.controllers import load_composite_controller_config
from robosuite.utils.observables import Observable, create_gaussian_noise_corrupter, sensor
from robosuite.wrappers import GymWrapper

from torchrl_bmrl.envs import control_period
from torchrl_bmrl.envs.acceleration import accelerate_robosuite
from torchrl_bmrl.envs.obstacles import why_not_fast
from torchrl_bmrl.errors import BMRLError

pytestmark = pytest.mark.robosuite

Act = Callable[[], np.ndarray]
OPTIONS = {"has_offscreen_renderer": False, "use_camera_obs": False, "reward_shaping": True}
TASKS = ["Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "Wipe"]
ARRAYS = [
    "qpos",
    "qvel",
    "act",
    "ctrl",
    "qacc",
    "qacc_warmstart",
    "sensordata",
    "site_xpos",
    "xpos",
]


def make(task: str, robot: str, seed: int = 0, **options: Any) -> Any:
    return robosuite.make(task, robots=robot, seed=seed, **(OPTIONS | options))


def both(task: str, robot: str, **options: Any) -> tuple[Any, Any]:
    """A stock and an accelerated environment."""
    envs = make(task, robot, **options), make(task, robot, **options)
    for env in envs:
        if task == "Wipe":
            env.early_terminations = False  # saturated actions collide at once
    return envs[0], accelerate_robosuite(envs[1])


def random_actions(env: Any, rng: np.random.Generator) -> Act:
    low, high = env.action_spec
    return lambda: rng.uniform(low, high)


def held_saturated_actions(env: Any, rng: np.random.Generator) -> Act:
    action = np.sign(rng.standard_normal(env.action_dim))
    return lambda: action


def switching_saturated_actions(env: Any, rng: np.random.Generator) -> Act:
    return lambda: np.sign(rng.standard_normal(env.action_dim))


def still_actions(env: Any, rng: np.random.Generator) -> Act:
    return lambda: np.zeros(env.action_dim)


ACTIONS = [random_actions, held_saturated_actions, switching_saturated_actions, still_actions]


def everything(env: Any) -> dict[str, Any]:
    """MuJoCo's state, what the robot and its controllers remember, observables' clocks."""
    data, robot = env.sim.data._data, env.robots[0]
    parts = robot.composite_controller.part_controllers
    arm, gripper = parts["right"], parts["right_gripper"]
    found = {name: np.array(getattr(data, name)) for name in ARRAYS}
    found |= {"time": data.time, "ncon": data.ncon, "timestep": env.timestep, "cur": env.cur_time}
    for name in ("recent_qpos", "recent_actions"):
        found[name] = getattr(robot, name).current
    for name in ("forcetorques", "pose", "vel", "acc"):
        found[name] = getattr(robot, f"recent_ee_{name}")["right"].current
    for name in ("ref_pos", "ref_ori_mat", "ref_pos_vel", "ref_ori_vel", "J_full", "joint_pos",
                 "joint_vel", "mass_matrix", "torques", "goal_pos", "initial_joint"):  # fmt: skip
        found[f"arm.{name}"] = np.array(getattr(arm, name))
    for name in ("joint_pos", "joint_vel", "goal_qvel"):
        found[f"gripper.{name}"] = np.array(getattr(gripper, name))
    for name, observable in env._observables.items():
        found[f"clock of {name}"] = observable._time_since_last_sample, observable._sampled
    return found


def assert_same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert list(ours) == list(theirs)
    for name, part in theirs.items():
        mine, part = np.asarray(ours[name]), np.asarray(part)
        assert mine.dtype == part.dtype, name
        np.testing.assert_array_equal(mine, part, err_msg=name)


def assert_same_steps(reference: Any, env: Any, act: Act, steps: int) -> None:
    before, moves = reference.sim.data.qpos.copy(), False
    for _ in range(steps):
        action = act()
        moves = moves or bool(action.any())
        theirs, ours = reference.step(action), env.step(action)
        assert_same(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]
        assert_same(everything(env), everything(reference))
    assert not moves or not np.array_equal(reference.sim.data.qpos, before)


def assert_same_episodes(reference: Any, env: Any, steps: int, actions: Any = ACTIONS) -> None:
    for number, kind in enumerate(actions):
        assert_same(env.reset(), reference.reset())
        act = kind(reference, np.random.default_rng(number))
        assert_same_steps(reference, env, act, steps)
    assert env.step.stepper is not None  # it was fast


@pytest.fixture
def no_warning() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        yield


# -- the same bits ---------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_warning")
@pytest.mark.parametrize("hard_reset", [True, False])
def test_a_few_steps_after_hard_and_soft_resets_equal_stock(hard_reset: bool) -> None:
    assert_same_episodes(*both("Lift", "Panda", hard_reset=hard_reset), steps=6)


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


def controller(**changes: Any) -> dict[str, Any]:
    config = load_composite_controller_config(robot="Panda")
    config["body_parts"]["right"].update(changes)
    return {"controller_configs": config}


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
        """Looks at every substep."""

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


# -- reasons ---------------------------------------------------------------------------------------


def replaced(patch: Any, env: Any, what: str) -> None:
    """Changes one thing that the fast step does not cover."""
    robot, parts = env.robots[0], env.robots[0].composite_controller.part_controllers
    arm = parts["right"]
    changes: dict[str, Callable[[], None]] = {
        "library": lambda: patch.setattr(control_period, "LIBRARY", "no libmujoco.so in folder"),
        "closed": lambda: patch.setattr(env, "sim", None),
        "robots": lambda: patch.setattr(env, "robots", [robot, robot]),
        "step": lambda: patch.setattr(type(env), "_pre_action", lambda *_: None),
        "viewer": lambda: patch.setattr(env, "has_renderer", True),
        "controller": lambda: patch.setitem(parts, "torso", object()),
        "arm": lambda: patch.setattr(arm, "uncoupling", False),
        "gripper": lambda: patch.setitem(parts, "right_gripper", object()),
        "interpolation": lambda: patch.setattr(arm, "interpolator_pos", object()),
        "parts": lambda: patch.setitem(robot._enabled_parts, "right", False),
        "numba": lambda: patch.setattr(control_period, "opspace_matrices", lambda *_: None),
        "joints": lambda: patch.setattr(arm, "qpos_index", arm.qpos_index[::-1]),
    }
    changes[what]()


KINDS = ["library", "closed", "robots", "step", "viewer", "controller", "arm", "gripper",
         "interpolation", "parts", "numba", "joints"]  # fmt: skip


def test_each_reason_has_a_kind_and_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make("Lift", "Panda")
    assert why_not_fast(env) is None
    for kind in KINDS:
        with monkeypatch.context() as patch:
            replaced(patch, env, kind)
            obstacle = why_not_fast(env)
            assert obstacle is not None
            assert obstacle.kind == kind
            assert str(obstacle) == obstacle.reason
            with pytest.raises(BMRLError, match="Lift cannot step fast"):
                accelerate_robosuite(env)
    assert why_not_fast(env) is None
    assert "step" not in vars(env)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "robot", "kind", "options"),
    [
        ("TwoArmLift", ["Panda", "Panda"], "robots", {}),
        ("TwoArmLift", "Baxter", "controller", {}),
        ("Lift", "PandaOmron", "robots", {}),
        ("Lift", "Panda", "arm", controller(type="JOINT_POSITION", input_max=1, input_min=-1,
                                            output_max=0.05, output_min=-0.05)),
        ("Lift", "Panda", "interpolation", controller(interpolation="linear")),
    ],
)  # fmt: skip
def test_robots_and_controllers_that_are_not_covered_are_refused(
    task: str, robot: Any, kind: str, options: dict[str, Any]
) -> None:
    env = make(task, robot, **options)
    obstacle = why_not_fast(env)
    assert obstacle is not None
    assert obstacle.kind == kind


def test_a_task_with_its_own_step_is_refused_and_a_replaced_step_kept() -> None:
    env = make("Lift", "Panda")
    env.step = lambda action: None
    with pytest.raises(BMRLError, match="delete it first"):
        accelerate_robosuite(env)
    del env.step

    def step(self: Any, action: np.ndarray) -> None: ...

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(env), "step", step)
        obstacle = why_not_fast(env)
    assert obstacle is not None
    assert obstacle.kind == "step"


def test_a_later_change_that_is_not_covered_takes_stocks_step_and_warns_once() -> None:
    reference, env = both("Lift", "Panda", hard_reset=False)
    for one in (reference, env):
        one.reset()
    act = random_actions(env, np.random.default_rng(0))
    assert_same_steps(reference, env, act, 3)
    for one in (reference, env):
        one.robots[0].composite_controller.part_controllers["right"].uncoupling = False
    with pytest.warns(RuntimeWarning, match="uncoupled") as caught:
        assert_same_steps(reference, env, act, 3)
    assert len(caught) == 1
    assert env.step.stepper is None
    assert_same(env.reset(), reference.reset())  # which brings new controllers
    assert_same_steps(reference, env, act, 3)
    assert env.step.stepper is not None


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
