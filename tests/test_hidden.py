"""What the hidden skills reward and call a success, on scenes that are made up."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("tqdm")
from torchrl_bmrl.envs.hidden import LiftToHeight, PushTowards, ReachAtSpeed, ReachHidden
from torchrl_bmrl.envs.table import TABLE_TOP
from torchrl_bmrl.experts.sawyer_families import (
    lifted_height,
    moved_speed,
    pushed_direction,
    reached_point,
)


def scene(**values: Any) -> Any:
    defaults = {
        "cube_velocity": np.zeros(3),
        "cube_position": np.zeros(3),
        "eef_position": np.zeros(3),
        "grasped": True,
        "control_timestep": 0.05,
    }
    return SimpleNamespace(**{**defaults, **values})


def pushed(length: float, angle: float) -> Any:
    turn = math.radians(angle)
    moved = length * np.array([math.cos(turn), math.sin(turn), 0.0])
    return scene(cube_displacement=moved)


@pytest.mark.parametrize(
    ("length", "angle", "success"),
    [(0.08, 60, True), (0.06, 60, False), (0.2, 78, True), (0.2, 79, False), (0.08, 240, False)],
)
def test_a_push_succeeds_7_cm_along_its_direction_and_at_most_a_third_as_far_aside(
    length: float, angle: float, success: bool
) -> None:
    skill, now = PushTowards(60), pushed(length, angle)
    assert skill.success(now) is success
    assert skill.reward_terms(now)["along"] == float(success)


def test_a_push_is_rewarded_for_velocity_along_its_direction() -> None:
    skill = PushTowards(90)
    terms = [
        skill.reward_terms(scene(cube_displacement=np.zeros(3), cube_velocity=velocity))["velocity"]
        for velocity in np.array([[0, 0.2, 0], [0.2, 0, 0], [0, -0.2, 0]])
    ]
    assert terms[0] > terms[1] > terms[2]


def lifted(height: float, speed: float = 0.0, grasped: bool = True) -> Any:
    return scene(
        cube_displacement=np.array([0.3, 0.1, height]),
        cube_velocity=np.array([0.0, 0.0, speed]),
        grasped=grasped,
    )


@pytest.mark.parametrize(
    ("now", "success"),
    [
        (lifted(0.10), True),
        (lifted(0.114, 0.02), True),
        (lifted(0.116), False),
        (lifted(0.084), False),
        (lifted(0.10, 0.05), False),
        (lifted(0.10, grasped=False), False),
    ],
)
def test_a_lift_succeeds_where_the_grasped_cube_is_still_within_15_mm_of_its_height(
    now: Any, success: bool
) -> None:
    assert LiftToHeight(10).success(now) is success


def test_a_lift_is_rewarded_by_the_distance_to_its_height_of_a_grasped_cube_alone() -> None:
    near, far, lost = (lifted(0.11), lifted(0.15), lifted(0.10, grasped=False))
    terms = [LiftToHeight(10).reward_terms(now)["height"] for now in (near, far, lost)]
    assert 1 > terms[0] > terms[1] > terms[2] == 0
    assert terms[0] == pytest.approx(1 - math.tanh(10 * 0.05**2))


def test_a_hidden_point_lies_relative_to_the_table_and_decides_success_within_2_cm() -> None:
    skill = ReachHidden(10, -5, 20)
    point = skill.begin(scene(), None)
    assert np.allclose(point - TABLE_TOP, [0.10, -0.05, 0.20])
    for distance, success in ((0.019, True), (0.021, False)):
        now = scene(goal_start=point, eef_position=point + np.array([distance, 0, 0]))
        assert skill.success(now) is success


def underway(seconds: float, x: float) -> Any:
    """On a way of 20 cm along x from 5 cm on."""
    start = np.array([0.05, 0.0, 1.0])
    return scene(
        start_position=start,
        goal_start=start + np.array([0.2, 0.0, 0.0]),
        stage_time=seconds,
        eef_position=np.array([x, 0.0, 1.0]),
    )


@pytest.mark.parametrize(
    ("seconds", "x", "success"),
    [
        (1.52, 0.20, True),  # three quarters of the way are over in this step
        (1.52, 0.23, False),
        (1.47, 0.197, False),
        (1.57, 0.207, False),
        (3.0, 0.25, False),  # arrived, but judged before
    ],
)
def test_a_speed_is_judged_in_the_step_in_which_three_quarters_of_the_way_are_over(
    seconds: float, x: float, success: bool
) -> None:
    assert ReachAtSpeed(100).success(underway(seconds, x)) is success


def test_the_pacemaker_moves_at_its_speed_and_waits_at_the_goal() -> None:
    skill = ReachAtSpeed(100)
    assert np.allclose(skill.pacemaker(underway(0.5, 0)), [0.10, 0, 1])
    assert np.allclose(skill.pacemaker(underway(0.5, 0), ahead=0.5), [0.15, 0, 1])
    assert np.allclose(skill.pacemaker(underway(9.0, 0)), [0.25, 0, 1])
    ahead, behind = (skill.reward_terms(underway(0.5, x))["pace"] for x in (0.15, 0.05))
    assert ahead == pytest.approx(behind)
    assert skill.reward_terms(underway(0.5, 0.10))["pace"] == 1


def observations(eef: torch.Tensor, cube: torch.Tensor) -> torch.Tensor:
    """Observations of an episode, (T, 33), with only these two parts."""
    data = torch.zeros(len(eef), 33, dtype=torch.float64)
    data[:, 23:26], data[:, -3:] = eef, cube
    return data


@pytest.mark.parametrize("angle", [0, 45, 200, 340])
def test_the_direction_of_a_push_is_measured(angle: float) -> None:
    turn = math.radians(angle)
    way = torch.tensor([[math.cos(turn), math.sin(turn), 0.3]], dtype=torch.float64)
    cube = torch.linspace(0, 0.1, 20, dtype=torch.float64).unsqueeze(1) * way + 0.7
    (found,) = pushed_direction(observations(torch.zeros(20, 3), cube))
    assert (found - angle + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)


def test_the_height_of_a_lift_is_measured_over_its_last_steps() -> None:
    cube = torch.full((30, 3), 0.8, dtype=torch.float64)
    cube[10:20, 2] += 0.3
    cube[20:, 2] += 0.12
    assert lifted_height(observations(cube, cube)) == (pytest.approx(12),)


def test_the_point_that_was_reached_is_measured_from_the_table() -> None:
    eef = torch.as_tensor(TABLE_TOP) + torch.tensor([[0, 0, 0], [0.05, -0.1, 0.2]])
    assert reached_point(observations(eef, eef)) == pytest.approx((5, -10, 20))


def test_the_speed_of_a_reach_is_measured_without_the_time_after_its_arrival() -> None:
    way = (torch.arange(100, dtype=torch.float64) * 0.004).clamp(max=0.2)  # 4 mm a step, 50 steps
    eef = torch.stack([way, torch.zeros(100), torch.ones(100)], 1)
    assert moved_speed(observations(eef, eef)) == (pytest.approx(80, rel=0.05),)


def test_the_distance_to_a_hidden_goal_is_unknown() -> None:
    """The goal that the observation shows is then the end-effector's own position."""
    evaluate = pytest.importorskip("torchrl_bmrl.pipeline.evaluate", exc_type=ImportError)
    eef = torch.rand(5, 3)
    hidden = TensorDict({"robot0_eef_pos": eef, "goal_pos": eef}, [5])
    assert np.isnan(evaluate._distance(hidden)).all()
    shown = TensorDict(
        {"robot0_eef_pos": eef, "goal_pos": eef + torch.tensor([0.0, 0.0, 0.1])}, [5]
    )
    assert np.allclose(evaluate._distance(shown), 0.1)
