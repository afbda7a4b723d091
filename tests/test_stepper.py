"""The fast step is robosuite's own, to the bit; what it does not cover is left to robosuite."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import mujoco
from robosuite.controllers import load_composite_controller_config

from torchrl_bmrl.envs import caching, sawyer, stepper
from torchrl_bmrl.envs.physics import check_mujoco, mujoco_library
from torchrl_bmrl.envs.sawyer import SawyerEnv
from torchrl_bmrl.envs.stepper import FastStepper, why_not_fast
from torchrl_bmrl.envs.tasks import make_robosuite_env, without_pictures
from torchrl_bmrl.errors import BMRLError, MissingExtraError, UnknownNameError
from torchrl_bmrl.experts.controllers import make_expert
from torchrl_bmrl.names import HORIZON, STEPPERS, TASKS

pytestmark = pytest.mark.robosuite

Act = Callable[[], np.ndarray]


def random_actions(env: SawyerEnv, seed: int) -> Act:
    rng = np.random.default_rng(seed)
    return lambda: rng.uniform(-1, 1, 7)


def zero_actions(env: SawyerEnv, seed: int) -> Act:
    return lambda: np.zeros(7)


def held_saturated_actions(env: SawyerEnv, seed: int) -> Act:
    """Full speed one way: into the table, the joints' limits and singular poses."""
    action = np.sign(np.random.default_rng(seed + 7).standard_normal(7))
    return lambda: action


def switching_saturated_actions(env: SawyerEnv, seed: int) -> Act:
    rng = np.random.default_rng(seed)
    return lambda: np.sign(rng.standard_normal(7))


def expert_actions(env: SawyerEnv, seed: int) -> Act:
    expert, rng = make_expert(env.task, env.robosuite_env), np.random.default_rng(seed)
    return lambda: np.clip(expert() + 0.2 * rng.standard_normal(7), -1, 1)


ACTIONS = [
    random_actions,
    zero_actions,
    held_saturated_actions,
    switching_saturated_actions,
    expert_actions,
]


@pytest.fixture(scope="module")
def pairs() -> Iterator[Callable[[str], tuple[SawyerEnv, SawyerEnv]]]:
    """robosuite's own model and step, and the fast one's, of a task."""
    made: dict[str, tuple[SawyerEnv, SawyerEnv]] = {}

    def pair(task: str) -> tuple[SawyerEnv, SawyerEnv]:
        if task not in made:
            made[task] = SawyerEnv(task, stepper="robosuite"), SawyerEnv(task)
        return made[task]

    yield pair
    for envs in made.values():
        for env in envs:
            env.close()


def everything(env: SawyerEnv) -> list[np.ndarray]:
    """What MuJoCo holds of the state and of what follows from it."""
    data = env.robosuite_env.sim.data._data
    names = ("qpos", "qvel", "qacc", "ctrl", "qfrc_bias", "site_xpos", "site_xmat", "xpos")
    return [np.array(getattr(data, name)) for name in names] + [np.array([data.time, data.ncon])]


def assert_same_steps(reference: SawyerEnv, env: SawyerEnv, act: Act, steps: int) -> None:
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
@pytest.mark.parametrize("task", TASKS)
def test_every_number_of_an_episode_equals_robosuites(
    pairs: Any, task: str, actions: Callable[..., Act], seed: int
) -> None:
    reference, env = pairs(task)
    for one in (reference, env):
        one.reset(seed=seed)
    assert_same_steps(reference, env, actions(reference, seed), HORIZON)
    assert env._fast is not None
    assert reference._fast is None


def test_a_few_steps_of_each_task_equal_robosuites(pairs: Any) -> None:
    for task in ("reach", "lift", "push_down"):
        reference, env = pairs(task)
        for one in (reference, env):
            one.reset(seed=3)
        assert_same_steps(reference, env, random_actions(env, 3), 10)


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


def made_with(changes: dict[str, Any]) -> list[SawyerEnv]:
    """A fast and a stock environment, reset, with another configuration of the arm's controller."""
    config = load_composite_controller_config(robot="Sawyer")
    config["body_parts"]["right"].update(changes)
    envs = [SawyerEnv("lift", stepper=name, controller_configs=config) for name in STEPPERS]
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
    "stiffer": {"kp": [100, 200, 300, 100, 200, 300], "damping_ratio": 0.7},
}
NOT_COVERED = {
    "JointPositionController": {"type": "JOINT_POSITION", "output_max": 0.05, "output_min": -0.05},
    "interpolate": {"interpolation": "linear"},
    "uncoupled": {"uncouple_pos_ori": False},
    "lite_physics": {"lite_physics": False},
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
    monkeypatch.setattr(sawyer, "_said", set())
    fast, reference = made_with(NOT_COVERED[reason])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert_same_steps(reference, fast, fast.action_space.sample, 5)
        fast.reset(seed=2)
        fast.step(fast.action_space.sample())
    assert [reason in str(warning.message) for warning in caught] == [True]
    assert "robosuite's own, and slow" in str(caught[0].message)
    with pytest.raises(BMRLError, match=reason):
        FastStepper(fast.robosuite_env)
    for env in (fast, reference):
        env.close()


def test_reasons_against_the_fast_step(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_robosuite_env("lift", use_object_obs=False)
    assert why_not_fast(env) is None
    with monkeypatch.context() as patch:
        patch.setattr(stepper, "opspace_matrices", lambda *_: None)
        assert "ENABLE_NUMBA" in (why_not_fast(env) or "")
    with monkeypatch.context() as patch:
        patch.setattr(stepper, "_library", "no libmujoco.so.1.0.0 in folder (there: none)")
        assert "no libmujoco" in (why_not_fast(env) or "")
    with monkeypatch.context() as patch:
        patch.setattr(type(env), "_pre_action", lambda *_: None)
        assert "a step of its own" in (why_not_fast(env) or "")
    env.close()
    env = make_robosuite_env("lift")
    assert "observables" in (why_not_fast(env) or "")
    env.close()


def test_an_unknown_stepper_is_answered_with_the_valid_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"'numpy'.*fast, robosuite"):
        SawyerEnv("lift", stepper="numpy")


# -- the lean model --------------------------------------------------------------------------------


def test_the_lean_model_has_a_thousandth_of_the_size_and_all_that_collides() -> None:
    env = make_robosuite_env("lift")
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


# -- MuJoCo's library ------------------------------------------------------------------------------

LIBRARIES = {
    "linux": "libmujoco.so.3.8.1",
    "darwin": "libmujoco.3.8.1.dylib",
    "win32": "mujoco.dll",
}
DECOYS = [
    "libmujoco.so",
    "libmujoco.so.3.8.10",
    "libmujoco.so.4.0.0",
    "libmujoco.4.0.0.dylib",
    "mujoco_core.dll",
]


@pytest.mark.parametrize("platform", LIBRARIES)
def test_the_library_is_that_of_the_imported_version_whatever_lies_beside_it(
    platform: str, tmp_path: Path
) -> None:
    for name in DECOYS:
        (tmp_path / name).touch()
    reason = mujoco_library(tmp_path, "3.8.1", platform)
    assert isinstance(reason, str)
    assert LIBRARIES[platform] in reason
    assert all(name in reason for name in DECOYS)
    (tmp_path / LIBRARIES[platform]).touch()
    assert mujoco_library(tmp_path, "3.8.1", platform) == tmp_path / LIBRARIES[platform]


def test_only_the_library_of_the_imported_mujoco_is_loaded() -> None:
    """A second one, of another version, ends the process."""
    found = mujoco_library(Path(mujoco.__file__).parent, mujoco.__version__, sys.platform)
    assert stepper._library == found
    assert isinstance(found, Path)
    assert found.is_file()


MISSING_LIBRARY = """
import sys, warnings
import mujoco
mujoco.__version__ = "3.7.77"
from torchrl_bmrl.envs.sawyer import SawyerEnv
env = SawyerEnv("reach")
env.reset(seed=0)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    env.step(env.action_space.sample())
print(*[str(warning.message) for warning in caught], sep="\\n")
"""


@pytest.mark.slow
def test_without_that_library_robosuites_step_stands_in_and_a_warning_names_those_there() -> None:
    done = subprocess.run(
        [sys.executable, "-c", MISSING_LIBRARY], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    assert "robosuite's own, and slow" in line
    assert "no libmujoco" in line
    assert mujoco.__version__ in line


@pytest.mark.parametrize("version", ["3.10.0", "3.12.1", "4.0.0", "10.0.0"])
def test_a_mujoco_that_robosuite_fails_with_is_refused_in_one_line(version: str) -> None:
    for good in ("3.4.0", "3.8.1", "3.9.9"):
        check_mujoco(good)
    with pytest.raises(MissingExtraError, match=rf"no usable mujoco \({version} is installed"):
        check_mujoco(version)
    with pytest.raises(MissingExtraError, match="files of it are gone"):
        check_mujoco(None)


UNSUPPORTED = """
import mujoco
mujoco.__version__ = "4.0.0"
import torchrl_bmrl.envs.sawyer
"""


def test_an_unsupported_mujoco_is_refused_at_import() -> None:
    done = subprocess.run(
        [sys.executable, "-c", UNSUPPORTED], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 1
    assert "MissingExtraError: no usable mujoco (4.0.0" in done.stderr.splitlines()[-1]


# -- compiled code ---------------------------------------------------------------------------------

STEPS = """
import sys, time
import numpy as np
import robosuite.utils.control_utils as control
{change}
from torchrl_bmrl.envs.sawyer import SawyerEnv
from torchrl_bmrl.envs.stepper import _control_period
from torchrl_bmrl.names import STEPPERS
joints = []
for stepper in STEPPERS:
    env = SawyerEnv("reach", stepper=stepper)
    env.reset(seed=0)
    started = time.monotonic()
    for _ in range(10):
        observation, *_ = env.step(np.full(7, 0.5))
    joints.append(observation["robot0_joint_pos"])
    seconds = locals().get("seconds", time.monotonic() - started)  # of the fast steps
assert env._fast is None
assert np.array_equal(*joints), np.abs(joints[0] - joints[1]).max()
print(sum(_control_period.stats.cache_misses.values()), seconds, *joints[0])
"""
CHANGES = {
    "as it is": "",
    # robosuite's step reads the module's attribute at every call
    "another function": """
import numba
import robosuite.controllers.parts.arm.osc as osc
@numba.njit(cache=False)
def error_of(desired, current):
    return 0.5 * stock(desired, current)
stock = control.orientation_error
control.orientation_error = osc.orientation_error = error_of
""",
    "another function below it": """
import numba
import robosuite.controllers.parts.arm.osc as osc
@numba.njit(cache=False)
def factor():
    return 0.25
@numba.njit(cache=False)
def error_of(desired, current):
    return factor() * stock(desired, current)
stock = control.orientation_error
control.orientation_error = osc.orientation_error = error_of
""",
}
CHANGES["another constant below it"] = CHANGES["another function below it"].replace("0.25", "0.75")


def played(folder: Path, change: str) -> tuple[int, float, list[float]]:
    """How often the step was compiled, the seconds of ten steps, where the arm is then."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(folder)
    done = subprocess.run(
        [sys.executable, "-c", STEPS.format(change=change)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    misses, seconds, *joints = done.stdout.split()
    return int(misses), float(seconds), [float(joint) for joint in joints]


@pytest.mark.slow
def test_only_the_first_run_of_a_user_compiles(tmp_path: Path) -> None:
    (first, compiling, _), (second, loading, _) = (played(tmp_path, "") for _ in range(2))
    assert (first, second) == (1, 0)
    assert loading < compiling / 3
    assert list((tmp_path / "torchrl_bmrl" / "numba").rglob("*_control_period*"))


@pytest.mark.slow
def test_a_changed_function_of_robosuite_is_compiled_anew_and_followed(tmp_path: Path) -> None:
    """In one cache, and each time to the bit what robosuite itself does with that function."""
    reached = {}
    for name, change in CHANGES.items():
        misses, _, reached[name] = played(tmp_path, change)
        assert misses == 1, name
    assert len({tuple(joints) for joints in reached.values()}) == len(CHANGES)
    for name, change in CHANGES.items():
        misses, _, joints = played(tmp_path, change)
        assert (misses, joints) == (0, reached[name]), name


def test_another_version_of_a_package_is_another_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    before = caching.fingerprint(stepper._control_period)
    monkeypatch.setattr(caching, "_versions", caching._versions.__wrapped__)
    assert caching.fingerprint(stepper._control_period) == before
    for package in ("robosuite", "mujoco", "numba", "numpy"):
        with monkeypatch.context() as patch:
            patch.setattr(
                caching, "version", lambda name, package=package: "0" if name == package else "1"
            )
            before, now = caching.fingerprint(stepper._control_period), before
            assert before != now


OFFSET = 1.0
TABLE = np.zeros(3)


def law(x: float, gain: float = 2.0) -> float:
    return gain * helper(x) + OFFSET + TABLE[0]


def helper(x: float) -> float:
    return x + 1


def test_a_fingerprint_sees_code_defaults_constants_and_what_is_called() -> None:
    seen = {caching.fingerprint(law)}
    assert {caching.fingerprint(law)} == seen
    here = globals()
    for name, value in {
        "OFFSET": 1.5,
        "TABLE": np.ones(3),
        "helper": lambda x: x + 2,
        "law.__defaults__": (3.0,),
    }.items():
        with pytest.MonkeyPatch.context() as patch:
            if "." in name:
                patch.setattr(law, "__defaults__", value)
            else:
                patch.setitem(here, name, value)
            seen.add(caching.fingerprint(law))
    assert len(seen) == 5
