"""Pairs of a stock and an accelerated robosuite environment, and their comparison."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import robosuite
from robosuite.controllers import load_composite_controller_config

from torchrl_bmrl.envs.acceleration import accelerate_robosuite

Act = Callable[[], np.ndarray]
OPTIONS = {"has_offscreen_renderer": False, "use_camera_obs": False, "reward_shaping": True}
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
    """A stock environment without cameras."""
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


def everything(env: Any) -> dict[str, Any]:
    """MuJoCo's state, the buffers of the robot and its controllers, and the observables' clocks."""
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
    """Equal names in the same order, equal dtypes and equal values."""
    assert list(ours) == list(theirs)
    for name, part in theirs.items():
        mine, part = np.asarray(ours[name]), np.asarray(part)
        assert mine.dtype == part.dtype, name
        np.testing.assert_array_equal(mine, part, err_msg=name)


def assert_same_steps(reference: Any, env: Any, act: Act, steps: int) -> None:
    """Both return the same and have the same state after every step, and the robot moves."""
    before, moves = reference.sim.data.qpos.copy(), False
    for _ in range(steps):
        action = act()
        moves = moves or bool(action.any())
        theirs, ours = reference.step(action), env.step(action)
        assert_same(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]
        assert_same(everything(env), everything(reference))
    assert not moves or not np.array_equal(reference.sim.data.qpos, before)


def controller(**changes: Any) -> dict[str, Any]:
    """Options of a Panda whose arm's controller has other settings."""
    config = load_composite_controller_config(robot="Panda")
    config["body_parts"]["right"].update(changes)
    return {"controller_configs": config}
