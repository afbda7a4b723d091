"""Episodes of another behaviour, which contexts are drawn from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("h5py")
pytest.importorskip("tqdm")

from tiny_family import FAMILY, make_walk

from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.experts.collect import WANDERING, collect_demonstrations, others_than
from torchrl_bmrl.tasks import Task, get_task


def collect_one_of_each(folder: Path, *tasks: Task) -> None:
    collect_demonstrations(
        folder,
        tasks,
        {task.name: 1 for task in tasks},
        valid_episodes=1,
        context_episodes=1,
        noise=0.0,
        seed=0,
        workers=1,
    )


def test_one_task_has_no_other_behaviour(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"context_episodes with one task; valid: .*two tasks"):
        collect_one_of_each(tmp_path, make_walk(0.0))
    assert not list(tmp_path.iterdir())


def record_alone(seed: int, *, noise: float, gains: object = None, after: object = ()) -> None:
    raise AssertionError("nothing is recorded")


def test_an_expert_that_cannot_act_in_other_tasks_is_refused_before_anything_is_recorded(
    tmp_path: Path,
) -> None:
    alone = replace(make_walk(0.0), record=record_alone)
    with pytest.raises(ConfigError, match=r"task walk_0 has a record without like.*valid: 0, or"):
        collect_one_of_each(tmp_path, alone, make_walk(90.0))
    assert not list(tmp_path.iterdir())


def test_others_are_different_tasks_in_an_order_that_the_seed_decides() -> None:
    members = [make_walk(float(angle)) for angle in range(12)]
    drawn = [others_than(members, "walk_3", seed=seed) for seed in range(40)]
    for others in drawn:
        assert len(others) == len({task.name for task in others}) == WANDERING
        assert "walk_3" not in {task.name for task in others}
    assert len({tuple(task.name for task in others) for others in drawn}) > 30
    assert {task.name for others in drawn for task in others} == {
        task.name for task in members if task.name != "walk_3"
    }
    assert others_than(members, "walk_3", seed=7) == drawn[7]
    assert len(others_than(members[:3], "walk_0", seed=0)) == 2
    assert len(others_than(members[:3], "", seed=0)) == 3


@pytest.mark.robosuite
def test_an_episode_like_others_acts_as_they_do_and_is_rewarded_as_itself() -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    task, other = (get_task(f"push_towards_{x}") for x in (0, 180))
    options = {"noise": 0.0, **{**task.options, "horizon": 40}}
    own, like = task.record(1, **options), task.record(1, like=[other], **options)
    theirs = other.record(1, **{"noise": 0.0, **{**other.options, "horizon": 40}})
    assert (like.actions == theirs.actions).all()
    assert not (like.actions == own.actions).all()
    assert (like.rewards != theirs.rewards).any()
    assert like.attributes["like"] == other.name
    assert "like" not in own.attributes
    with pytest.raises(BMRLError, match="like is reach; valid: tasks with the same kind"):
        task.record(1, like=[get_task("reach")], **options)
    with pytest.raises(BMRLError, match=r"like is push_towards_180 and after reach; valid: one of"):
        task.record(1, like=[other], after=[get_task("reach")], **options)


def test_a_parameter_belongs_to_one_split() -> None:
    members = {"train": [(0.0,), (40.0,)], "inside": [(40.0,)], "outside": []}
    with pytest.raises(ConfigError, match=r"contain \(40.0,\) twice; valid: each parameter once"):
        replace(FAMILY, members=members)
    with pytest.raises(UnknownNameError, match="walk_41"):
        FAMILY.told("walk_41")
