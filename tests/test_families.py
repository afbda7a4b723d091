"""Families: members, names, and that the observation does not show the parameter."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("tqdm")
from torchrl_bmrl.envs.hidden import HIDDEN, LiftToHeight, PushTowards, ReachAtSpeed, ReachHidden
from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.families import (
    SPLITS,
    Family,
    find_family,
    get_family,
    register_family,
    registered_families,
    tasks_of,
)
from torchrl_bmrl.tasks import FAMILIES, DemonstrationFiles, Task, get_task

SAWYER = tuple(HIDDEN)


def turn(angle: float) -> Task:
    return Task(name=f"turn_{angle}", files=DemonstrationFiles(path="x.hdf5"))


def turning(**changes):
    members = {"train": [(0,), (90,)], "inside": [(45,)], "outside": [(120,)]}
    given = {"name": "turn", "parameters": ("angle",), "members": members, "make": turn}
    return Family(**(given | changes))


def test_the_nearest_member_of_a_direction_may_lie_beyond_the_end_of_the_turn():
    pytest.importorskip("robosuite", exc_type=ImportError)
    from torchrl_bmrl.studies.families_methods import nearest_code

    members = {"train": [(0,), (100,), (300,)], "inside": [(120,)], "outside": [(350,)]}
    for period, expected in ((360.0, [1, 0]), (None, [1, 2])):
        family = turning(members=members, period=period)
        codes = torch.tensor([family.told(f"turn_{x}") for x in (0, 100, 300)])
        held_out = [torch.tensor(family.told(f"turn_{x}")) for x in (120, 350)]
        assert [nearest_code(codes, x, family.repeats) for x in held_out] == expected


def test_the_four_families_of_the_sawyer_are_registered():
    assert set(SAWYER) <= set(registered_families())


@pytest.mark.parametrize("name", SAWYER)
def test_no_held_out_member_is_trained_and_every_member_has_its_own_name(name):
    family = get_family(name)
    names = [task.name for split in SPLITS for task in family.tasks(split)]
    assert len(set(names)) == len(names)
    assert all(len(family.members[split]) >= 4 for split in SPLITS)


@pytest.mark.parametrize("name", SAWYER)
def test_members_inside_lie_within_the_trained_range_and_those_outside_do_not(name):
    family = get_family(name)
    trained = np.array(family.members["train"], dtype=float)
    low, high = trained.min(0), trained.max(0)

    def within(parameter):
        return bool(((low <= parameter) & (parameter <= high)).all())

    assert all(within(np.array(parameter)) for parameter in family.members["inside"])
    assert not any(within(np.array(parameter)) for parameter in family.members["outside"])


@pytest.mark.parametrize("name", SAWYER)
def test_a_member_is_found_by_its_name(name):
    family = get_family(name)
    for split in SPLITS:
        for task, parameter in zip(family.tasks(split), family.members[split], strict=True):
            assert get_task(task.name).options["skills"] == task.options["skills"]
            assert family.parameter(task.name) == tuple(parameter)


def test_a_familys_name_stands_for_its_trained_members():
    family = get_family("push_towards")
    names = [task.name for task in family.tasks("train")]
    assert [task.name for task in tasks_of("push_towards")] == names


def test_settings_take_a_familys_name_beside_tasks():
    pytest.importorskip("h5py")
    from torchrl_bmrl.pipeline.task_files import make_tasks

    names = [task.name for task in get_family("push_towards").tasks("train")]
    assert [task.name for task in make_tasks(["lift", "push_towards"])] == ["lift", *names]


def test_of_two_families_with_the_same_trained_members_the_chosen_one_is_taken():
    own = turning(name="rotate", members={"train": [(0,), (90,)], "inside": [], "outside": [(7,)]})
    names = [task.name for task in own.tasks("train")]
    register_family(turning())
    try:
        assert find_family(names, names).name == "turn"
        register_family(own)
        assert find_family(["mine:rotate"], names) is own
        assert get_task("turn_7").name == "turn_7"  # of a family with another name
        with pytest.raises(ConfigError, match=r"valid: .*tasks=\[turn\] or tasks=\[rotate\]"):
            find_family(names, names)
    finally:
        FAMILIES.pop("turn")
        FAMILIES.pop("rotate", None)


@pytest.mark.parametrize("kind", [list, tuple])
def test_a_run_has_the_family_that_its_settings_name_in_any_sequence(kind, tmp_path):
    pytest.importorskip("h5py")
    pytest.importorskip("matplotlib")
    from torchrl_bmrl.pipeline import Run
    from torchrl_bmrl.pipeline.settings import Settings

    own = turning(name="rotate", members={"train": [(0,), (90,)], "inside": [], "outside": [(7,)]})
    try:
        register_family(turning())
        register_family(own)
        assert Run(Settings(tasks=kind(["rotate"]), run_dir=str(tmp_path / "run"))).family is own
    finally:
        FAMILIES.pop("turn", None)
        FAMILIES.pop("rotate", None)


def test_members_can_be_composed():
    parts = [
        get_family("reach_hidden").tasks("train")[0],
        get_family("lift_to_height").tasks("train")[1],
    ]
    task = get_task("-".join(part.name for part in parts))
    assert task.stages == tuple(part.name for part in parts)


def test_the_told_parameter_is_scaled_to_one_over_the_trained_members():
    family = get_family("lift_to_height")
    told = [family.told(task.name)[0] for task in family.tasks("train")]
    assert min(told) == -1
    assert max(told) == 1
    assert family.told(family.tasks("outside")[-1].name)[0] > 1
    cosine, sine = get_family("push_towards").told("push_towards_90")
    assert abs(cosine) < 1e-9
    assert sine == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "a-b"},
        {"members": {"train": [(0,)]}},
        {"members": {"train": [], "inside": [], "outside": []}},
        {"parameters": ("x", "y")},
    ],
)
def test_a_family_that_is_not_valid_is_refused(changes):
    with pytest.raises(ConfigError, match="valid"):
        turning(**changes)


def test_unknown_names_list_the_valid_ones():
    with pytest.raises(UnknownNameError, match="inside"):
        turning().tasks("test")
    with pytest.raises(UnknownNameError, match="turn_45"):
        turning().parameter("turn_46")
    with pytest.raises(UnknownNameError, match="push_towards"):
        get_family("push")
    with pytest.raises(UnknownNameError, match="push_towards"):
        get_task("push_towards_46")


@pytest.mark.parametrize("value", ["1", None, True, float("nan"), float("inf")])
def test_a_parameter_is_a_finite_number(value):
    with pytest.raises(BMRLError, match="direction"):
        PushTowards(value)
    with pytest.raises(BMRLError, match="speed"):
        ReachAtSpeed(-1)


PAIRS = {
    "push_towards": (PushTowards(0), PushTowards(75)),
    "reach_hidden": (ReachHidden(0, 0, 20), ReachHidden(5, -9, 11)),
    "lift_to_height": (LiftToHeight(6), LiftToHeight(20)),
    "reach_at_speed": (ReachAtSpeed(30), ReachAtSpeed(120)),
}


@pytest.mark.robosuite
@pytest.mark.parametrize("name", SAWYER)
def test_members_differ_in_rewards_and_never_in_observations(name):
    from torchrl_bmrl.envs.tabletop import TabletopEnv

    envs = [TabletopEnv(skill) for skill in PAIRS[name]]
    rng = np.random.default_rng(0)
    observations = [env.reset(seed=3)[0] for env in envs]
    rewards = []
    # Downwards, closed, upwards, so that the heights differ, too.
    plan = [(0, 0, -0.7, -1)] * 14 + [(0, 0, 0, 1)] * 12 + [(0, 0.5, 1, 1)] * 20
    for x, y, z, grip in plan:
        action = np.clip([x, y, z, 0, 0, 0, grip] + 0.05 * rng.standard_normal(7), -1, 1)
        steps = [env.step(action) for env in envs]
        observations = [step[0] for step in steps]
        for key, part in observations[0].items():
            assert np.array_equal(part, observations[1][key]), key
        rewards.append([step[1] for step in steps])
    assert np.ptp(np.array(rewards), axis=1).max() > 0.01


@pytest.mark.robosuite
@pytest.mark.parametrize("name", SAWYER)
def test_an_expert_does_what_its_member_asks_for(name):
    for task in (get_family(name).tasks("inside")[0], get_family(name).tasks("train")[-1]):
        episode = task.record(1, noise=0.1, **task.options)
        assert episode.extras["successes"].any(), task.name


@pytest.mark.robosuite
@pytest.mark.parametrize("name", SAWYER)
def test_states_of_a_member_are_exact_and_both_steppers_agree(name):
    from torchrl_bmrl.envs.tabletop import TabletopEnv

    fast, slow = (TabletopEnv(PAIRS[name][0], stepper=x) for x in ("fast", "robosuite"))
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (12, 7))
    for env in (fast, slow):
        env.reset(seed=5)
    before = [fast.step(action) for action in actions[:6]]
    for action, mine in zip(actions[:6], before, strict=True):
        assert slow.step(action)[1] == mine[1]
    state = fast.get_state()
    expected = [fast.step(action)[1] for action in actions[6:]]
    other = TabletopEnv(PAIRS[name][0])
    other.reset(seed=9)
    other.set_state(state)
    assert [other.step(action)[1] for action in actions[6:]] == expected


@pytest.mark.robosuite
def test_the_speeds_of_a_composition_are_measured_from_its_own_start():
    from torchrl_bmrl.envs.tabletop import TabletopEnv
    from torchrl_bmrl.experts.controllers import make_expert
    from torchrl_bmrl.experts.sawyer_families import make_member
    from torchrl_bmrl.tasks import compose_tasks

    parts = [make_member("reach_hidden", 0, 10, 15), make_member("reach_at_speed", 60)]
    task = compose_tasks(parts)
    episode = task.record(0, noise=0.0, **task.options)
    assert episode.extras["stages"].max() >= 1
    assert episode.extras["successes"].any()
    env = TabletopEnv(task.options["skills"])
    scene = env.robosuite_env
    env.reset(seed=0)
    at_rest, expert = scene.start_position.copy(), make_expert(scene)
    while scene.stage == 0:
        env.step(expert())
    assert np.array_equal(scene.start_position, scene.eef_position)
    assert np.linalg.norm(scene.start_position - at_rest) > 0.05
    assert scene.stage_time == 0
    env.step(np.zeros(7))
    assert scene.stage_time == pytest.approx(0.05)


@pytest.mark.robosuite
@pytest.mark.parametrize(
    ("name", "parameter", "task"),
    [
        ("PushTowards", {"direction": 45}, "push_towards_45"),
        ("ReachHidden", {"x": 5, "y": -5}, "reach_hidden_5_m5_20"),
        ("LiftToHeight", {"height": 7.5}, "lift_to_height_7.5"),
        ("ReachAtSpeed", {"speed": 35}, "reach_at_speed_35"),
    ],
)
def test_gymnasium_ids_take_the_parameter(name, parameter, task):
    import gymnasium

    import torchrl_bmrl.envs  # noqa: F401 (registers the ids)

    assert gymnasium.make(f"bmrl/Sawyer{name}-v0", **parameter).unwrapped.task == task
    vector = gymnasium.make_vec(f"bmrl/Sawyer{name}-v0", num_envs=2, **parameter)
    assert vector.reset(seed=0)[0]["goal_pos"].shape == (2, 3)
