"""What the fast step does not cover is refused with a reason, or takes robosuite's step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

from stock_robosuite import assert_same, assert_same_steps, both, controller, make, random_actions

from torchrl_bmrl.envs import control_period, operational_space
from torchrl_bmrl.envs.acceleration import accelerate_robosuite
from torchrl_bmrl.envs.obstacles import why_not_fast
from torchrl_bmrl.errors import BMRLError

pytestmark = pytest.mark.robosuite


def replaced(patch: Any, env: Any, what: str) -> None:
    """Changes one part so that the fast step does not cover it."""
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
        "numba": lambda: patch.setattr(operational_space, "OF_ROBOSUITE", (None, lambda *_: None)),
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
