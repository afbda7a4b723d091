"""Demonstrations of a run's tasks: their task, their statistics, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

from episode_files import PARTS, TASK_PARTS, make_episode, write_file
from tensordict import TensorDict

from torchrl_bmrl.data.demonstrations import (
    demonstration_path,
    load_transitions,
    read_demonstrations,
    read_statistics,
    write_statistics,
)
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.tasks import get_task

REACH, LIFT = get_task("reach"), get_task("lift")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder of two tasks' demonstrations."""
    write_file(tmp_path / "reach.hdf5", [5, 6, 4], train=2, parts=TASK_PARTS)
    write_file(tmp_path / "lift.hdf5", [9, 8, 7], train=2, parts=TASK_PARTS)
    return tmp_path


def test_demonstrations_know_their_task(runs: Path) -> None:
    path = demonstration_path(runs, "lift")
    data = read_demonstrations(path, LIFT, index=1)
    assert isinstance(data, TensorDict)
    assert data["task"].tolist() == [1] * 24
    assert set(data.keys()) == {*TASK_PARTS, "action", "episode", "step", "next", "task"}
    assert len(read_demonstrations(path, LIFT, split="valid", index=1)) == 7


def test_parts_that_the_tasks_do_not_have_are_left_out(tmp_path: Path) -> None:
    write_file(tmp_path / "lift.hdf5", parts={**TASK_PARTS, **PARTS})
    data = read_demonstrations(tmp_path / "lift.hdf5", LIFT, index=1)
    assert set(data.keys()) == {*TASK_PARTS, "action", "episode", "step", "next", "task"}


@pytest.mark.parametrize("name", TASK_PARTS)
def test_a_part_that_is_missing_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / "lift.hdf5"
    write_file(path, parts={part: kind for part, kind in TASK_PARTS.items() if part != name})
    with pytest.raises(DataError, match=rf"lift\.hdf5: data/demo_0/obs/{name}: missing"):
        read_demonstrations(path, LIFT, index=1)


@pytest.mark.parametrize("name", TASK_PARTS)
def test_tasks_whose_parts_have_other_sizes_are_refused_together(runs: Path, name: str) -> None:
    (size,), dtype = TASK_PARTS[name]
    path = runs / "lift.hdf5"
    write_file(path, train=2, parts={**TASK_PARTS, name: ((size + 1,), dtype)})
    with pytest.raises(
        DataError, match=rf"lift\.hdf5: .*{name} \({size + 1},\).*valid: .*of reach"
    ):
        write_statistics(runs, [REACH, LIFT])
    assert not (runs / "statistics.json").exists()


def rewrite(path: Path, **changes: Any) -> None:
    """Writes a file of two episodes with some fields changed."""
    episode = replace(make_episode(parts=TASK_PARTS), **changes)
    write_episodes(path, [episode, episode], env_args={}, masks={"train": [0]})


def test_tasks_whose_actions_have_other_sizes_are_refused_together(runs: Path) -> None:
    rewrite(runs / "lift.hdf5", actions=np.zeros((5, 6)))
    with pytest.raises(DataError, match=r"lift\.hdf5: .*action \(6,\); valid: .*action \(7,\)"):
        write_statistics(runs, [REACH, LIFT])


def test_demonstrations_without_successes_are_refused(tmp_path: Path) -> None:
    rewrite(tmp_path / "lift.hdf5", extras={})
    with pytest.raises(DataError, match=r"lift\.hdf5: .*no successes; valid: successes \(T,\)"):
        read_demonstrations(tmp_path / "lift.hdf5", LIFT, index=1)


def test_demonstrations_that_terminate_are_refused(tmp_path: Path) -> None:
    rewrite(tmp_path / "lift.hdf5", terminated=np.arange(5) == 4)
    with pytest.raises(DataError, match=r"lift\.hdf5: .*terminate"):
        read_demonstrations(tmp_path / "lift.hdf5", LIFT, index=1)


def observations(lengths: Sequence[int], count: int) -> np.ndarray:
    """The tasks' observation, computed from the episodes that were written to the files."""
    rows = []
    for i, steps in enumerate(lengths[:count]):
        parts = make_episode(i, steps, parts=TASK_PARTS).observations
        q = parts["robot0_joint_pos"]
        names = ("gripper_qpos", "joint_vel", "eef_pos", "eef_quat")
        others = [parts[f"robot0_{name}"] for name in names]
        rows.append(np.concatenate([np.sin(q), np.cos(q), *others, parts["goal_pos"]], axis=1))
    return np.concatenate(rows)


def test_statistics_are_kept_for_each_task_and_over_all(runs: Path) -> None:
    statistics = write_statistics(runs, [REACH, LIFT])
    reach, lift = observations([5, 6], 2), observations([9, 8], 2)  # the mask train
    # Each task has the same weight, however many steps it has.
    loc = (reach.mean(0) + lift.mean(0)) / 2
    second = (((reach - loc) ** 2).mean(0) + ((lift - loc) ** 2).mean(0)) / 2
    expected = [
        (None, loc, np.sqrt(second)),
        (REACH, reach.mean(0), reach.std(0)),
        (LIFT, lift.mean(0), lift.std(0)),
    ]
    for task, mean, scale in expected:
        read = read_statistics(runs, task)
        np.testing.assert_allclose(read.loc.numpy(), mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(read.scale.numpy(), scale, rtol=1e-5, atol=1e-5)
    assert torch.equal(read_statistics(runs).loc, statistics.loc)
    assert torch.equal(read_statistics(runs).scale, statistics.scale)
    tasks = json.loads((runs / "statistics.json").read_text())["tasks"]
    assert {task: tasks[task]["transitions"] for task in tasks} == {"reach": 11, "lift": 17}


@pytest.mark.parametrize(
    "content",
    [None, "", "[]", "{}", '{"loc": [1.0], "scale": [0.0]}', '{"loc": [1.0], "scale": [1.0, 2.0]}'],
)
def test_damaged_statistics_are_named(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "statistics.json").write_text(content)
    with pytest.raises(DataError, match=r"statistics\.json: "):
        read_statistics(tmp_path)


def test_statistics_of_a_task_that_has_none_are_refused(runs: Path) -> None:
    write_statistics(runs, [REACH])
    with pytest.raises(DataError, match=r"statistics\.json: lift: "):
        read_statistics(runs, LIFT)


def test_transitions_are_normalised(runs: Path) -> None:
    statistics = write_statistics(runs, [REACH, LIFT])
    data = load_transitions(runs, LIFT, statistics, split="valid", index=1)
    episode = make_episode(2, 7, parts=TASK_PARTS)
    assert data["observation"].shape == data["next", "observation"].shape == (7, 33)
    goal = (episode.next_observations["goal_pos"] - statistics.loc[-3:].numpy()) / (
        statistics.scale[-3:].numpy()
    )
    np.testing.assert_allclose(data["next", "observation"][:, -3:].numpy(), goal, rtol=1e-4)
    assert torch.equal(data["observation"][1:], data["next", "observation"][:-1])
    # Normalising does not change what is stored.
    raw = read_demonstrations(demonstration_path(runs, "lift"), LIFT, split="valid", index=1)
    np.testing.assert_array_equal(raw["goal_pos"].numpy(), episode.observations["goal_pos"])
