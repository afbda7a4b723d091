"""Each shortcut returns what robosuite's own method returns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import robosuite
from robosuite.models.grippers import gripper_factory

from torchrl_bmrl.envs.shortcuts import take_shortcuts

pytestmark = pytest.mark.robosuite


def make(task: str) -> Any:
    env = robosuite.make(
        task, robots="Panda", seed=0, use_camera_obs=False, has_offscreen_renderer=False
    )
    env.reset()
    take_shortcuts(env)
    return env


def stock(env: Any, name: str, *arguments: Any, **options: Any) -> Any:
    """What the class's own method returns, without shortcuts below it either."""
    own = {key: vars(env).pop(key) for key in NAMES if key in vars(env)}
    try:
        return getattr(env, name)(*arguments, **options)
    finally:
        vars(env).update(own)


NAMES = ("check_contact", "_check_grasp", "_gripper_to_target", "_get_wipe_information")


@pytest.fixture(scope="module")
def lift() -> Iterator[Any]:
    env = make("Lift")
    yield env
    env.close()


def touch(env: Any, offset: float, opened: float = 0.019) -> None:
    """Puts the cube ``offset`` [m] from the middle of the fingers, each ``opened`` [m] from it."""
    sim, gripper = env.sim, env.robots[0].gripper["right"]
    fingers = [sim.model.get_joint_qpos_addr(joint) for joint in gripper.joints]
    sim.data.qpos[fingers] = [opened, -opened]
    sim.forward()
    left, right = (
        np.mean([sim.data.get_geom_xpos(geom) for geom in geoms], axis=0)
        for geoms in map(gripper.important_geoms.get, ("left_fingerpad", "right_fingerpad"))
    )
    place = (left + right) / 2 + offset * (left - right) / np.linalg.norm(left - right)
    sim.data.set_joint_qpos(env.cube.joints[0], np.append(place, [1.0, 0, 0, 0]))
    sim.forward()


@pytest.mark.parametrize(
    ("offset", "opened", "touched"),
    [
        (0.0, 0.019, [True, True]),
        (0.02, 0.04, [True, False]),
        (-0.02, 0.04, [False, True]),
        (0.0, 0.04, [False, False]),
    ],
)
def test_contacts_and_grasps_are_robosuites(
    lift: Any, offset: float, opened: float, touched: list[bool]
) -> None:
    touch(lift, offset, opened)
    gripper = lift.robots[0].gripper
    model, pads = gripper["right"], gripper["right"].important_geoms
    table = "table_collision"
    geoms = [lift.cube, lift.cube.contact_geoms, lift.cube.contact_geoms[0], table]
    geoms += [pads["left_fingerpad"], pads["right_fingerpad"], model]
    for first in geoms:
        for second in (None, *geoms):
            expected = stock(lift, "check_contact", first, second)
            assert lift.check_contact(first, second) == expected
    sides = ("left_fingerpad", "right_fingerpad")
    assert [lift.check_contact(pads[side], lift.cube) for side in sides] == touched
    for one in (gripper, model):
        for target in (lift.cube, lift.cube.contact_geoms):
            grasped = lift._check_grasp(one, target)
            assert grasped == stock(lift, "_check_grasp", one, target) == all(touched)


def test_distances_to_bodies_sites_and_geoms_are_robosuites(lift: Any) -> None:
    touch(lift, 0.2)
    cube, gripper = lift.cube, lift.robots[0].gripper
    for one in (gripper, gripper["right"]):
        for target, kind in (
            (cube, "body"),
            (cube.root_body, "body"),
            ("table_top", "site"),
            (cube.contact_geoms[0], "geom"),
        ):
            for distance in (False, True):
                arguments = one, target, kind, distance
                np.testing.assert_array_equal(
                    lift._gripper_to_target(*arguments),
                    stock(lift, "_gripper_to_target", *arguments),
                )


def test_another_gripper_is_looked_at_anew(lift: Any) -> None:
    touch(lift, 0.0)
    assert lift._check_grasp(lift.robots[0].gripper, lift.cube)
    absent = gripper_factory("RethinkGripper", idn="absent")
    assert not lift._check_grasp(absent, lift.cube)
    assert lift._check_grasp(lift.robots[0].gripper, lift.cube)


def test_the_markers_that_are_left_are_robosuites() -> None:
    env = make("Wipe")
    markers = env.model.mujoco_arena.markers
    for wiped in ([], markers[:1], markers[3:7], markers[:-1], markers):
        env.wiped_markers = list(wiped)
        for ours, theirs in zip(
            env._get_wipe_information(), stock(env, "_get_wipe_information"), strict=True
        ):
            np.testing.assert_array_equal(ours, theirs)
    env.close()


def test_a_task_with_its_own_method_keeps_it() -> None:
    env = robosuite.make("Lift", robots="Panda", use_camera_obs=False, has_offscreen_renderer=False)
    own = env.check_contact = lambda *_: True
    take_shortcuts(env)
    assert env.check_contact is own
    assert "_check_grasp" in vars(env)
    assert "_get_wipe_information" not in vars(env)
    env.close()
