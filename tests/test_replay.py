"""Demonstrations as TensorDicts, and what their buffers sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_bmrl.data import (
    make_multi_task_replay_buffer,
    make_replay_buffer,
    stack_episodes,
    with_previous,
)
from torchrl_bmrl.errors import BMRLError

LENGTHS = (4, 1, 3)


def episodes() -> list[dict[str, Any]]:
    """Each value tells its episode (hundreds) and time."""
    result = []
    for number, length in enumerate(LENGTHS):
        time = 100.0 * number + np.arange(length + 1)
        result.append(
            {
                "obs": {"x": time[:-1, None], "y": np.tile(-time[:-1, None], 2)},
                "next_obs": {"x": time[1:, None], "y": np.tile(-time[1:, None], 2)},
                "actions": np.tile(time[:-1, None] / 1000, 7),
                "rewards": time[:-1],
                "successes": np.arange(length) == 1,
            }
        )
    return result


def test_stacked_episodes_keep_every_step_in_its_place() -> None:
    data = stack_episodes(episodes(), task=2)
    assert data.batch_size == (8,)
    assert data["episode"].tolist() == [0, 0, 0, 0, 1, 2, 2, 2]
    assert data["step"].tolist() == [0, 1, 2, 3, 0, 0, 1, 2]
    time = (100 * data["episode"] + data["step"]).double()
    assert torch.equal(data["x"], time.unsqueeze(-1))
    assert torch.equal(data["next", "x"], time.unsqueeze(-1) + 1)
    assert torch.equal(data["next", "y"], -(time + 1).unsqueeze(-1).expand(8, 2))
    assert torch.equal(data["next", "reward"], time.float().unsqueeze(-1))
    torch.testing.assert_close(data["action"], (time / 1000).float().unsqueeze(-1).expand(8, 7))
    success = [False, True, False, False, False, False, True, False]
    assert data["next", "success"].squeeze(-1).tolist() == success


def test_stacked_episodes_have_torchrl_s_dtypes_and_shapes() -> None:
    data = stack_episodes(episodes(), task=2)
    assert data["x"].dtype == data["next", "x"].dtype == torch.float64
    assert data["action"].dtype == data["next", "reward"].dtype == torch.float32
    for key in ("reward", "done", "terminated", "truncated", "success"):
        assert data["next", key].shape == (8, 1)
    for key in ("done", "terminated", "truncated", "success"):
        assert data["next", key].dtype == torch.bool
    for key in ("task", "episode", "step"):
        assert data[key].dtype == torch.int64
        assert data[key].shape == (8,)
    assert data["task"].unique().item() == 2


def test_an_episode_ends_by_truncation_and_never_by_termination() -> None:
    data = stack_episodes(episodes(), task=0)
    last = [False, False, False, True, True, False, False, True]
    assert data["next", "truncated"].squeeze(-1).tolist() == last
    assert data["next", "done"].squeeze(-1).tolist() == last
    assert not data["next", "terminated"].any()
    data["next", "done"].zero_()
    assert data["next", "truncated"].any()  # the flags are tensors of their own


def test_no_episodes_are_refused() -> None:
    with pytest.raises(BMRLError, match="at least one"):
        stack_episodes([], task=0)


def test_the_previous_transition_is_of_the_same_episode() -> None:
    keys = ["x", "action", ("next", "reward"), ("next", "x"), "episode", "step"]
    data = stack_episodes(episodes(), task=0)
    before = data.clone()
    result = with_previous(data, keys)
    assert torch.equal(result["previous", "episode"], data["episode"])
    assert torch.equal(result["previous", "step"], (data["step"] - 1).clamp(min=0))
    later = data["step"] > 0
    assert torch.equal(result["previous", "next", "x"][later], data["x"][later])
    first = ~later
    for key in keys:
        assert torch.equal(result["previous"][key][first], data[key][first])
    assert set(data.keys(True)) == set(before.keys(True))  # the input stays as it was
    assert (data == before).all()


def numbered(start: int, rows: int, task: int = 0) -> TensorDict:
    return TensorDict(
        {
            "number": torch.arange(start, start + rows),
            "task": torch.full((rows,), task),
            "next": {"double": 2.0 * torch.arange(start, start + rows)},
        },
        batch_size=[rows],
    )


def test_a_buffer_samples_all_of_its_rows_whole() -> None:
    buffer = make_replay_buffer(numbered(10, 20), batch_size=64)
    assert len(buffer) == 20
    torch.manual_seed(0)
    drawn = torch.cat([buffer.sample() for _ in range(5)])
    assert drawn.batch_size == (320,)
    assert sorted(drawn["number"].unique().tolist()) == list(range(10, 30))
    assert torch.equal(drawn["next", "double"], 2.0 * drawn["number"])
    assert drawn["number"].bincount()[10:].max() < 3 * 320 / 20  # about evenly


def test_a_multi_task_sample_has_a_row_per_task_from_its_own_data() -> None:
    sizes = (30, 5, 12)
    buffer = make_multi_task_replay_buffer(
        [numbered(1000 * i, rows, task=i) for i, rows in enumerate(sizes)], batch_size=16
    )
    torch.manual_seed(0)
    samples = [buffer.sample() for _ in range(20)]
    assert {sample.batch_size for sample in samples} == {(3, 16)}
    numbers = torch.cat([sample["number"] for sample in samples], -1)
    tasks = torch.cat([sample["task"] for sample in samples], -1)
    for i, rows in enumerate(sizes):
        assert tasks[i].unique().item() == i
        assert sorted(numbers[i].unique().tolist()) == list(range(1000 * i, 1000 * i + rows))
    double = torch.cat([sample["next", "double"] for sample in samples], -1)
    assert torch.equal(double, 2.0 * numbers)


@pytest.mark.parametrize("multi_task", [False, True])
def test_the_same_seed_draws_the_same_samples(multi_task: bool) -> None:
    def draw(seed: int) -> torch.Tensor:
        if multi_task:
            data = [numbered(0, 50), numbered(100, 50)]
            buffer = make_multi_task_replay_buffer(data, batch_size=8)
        else:
            buffer = make_replay_buffer(numbered(0, 50), batch_size=8)
        torch.manual_seed(seed)
        return torch.stack([buffer.sample()["number"] for _ in range(3)])

    assert torch.equal(draw(0), draw(0))
    assert not torch.equal(draw(0), draw(1))
    rows = draw(0)
    assert not torch.equal(rows[0], rows[1])


def test_data_of_a_buffer_lie_where_they_are_told_to(tmp_path: Any) -> None:
    make_replay_buffer(numbered(0, 50), batch_size=8, scratch_dir=str(tmp_path / "map"))
    assert any(path.is_file() for path in (tmp_path / "map").rglob("*"))


@pytest.mark.parametrize("key", ["x", ("next", "reward")])
def test_numbers_that_are_not_finite_do_not_get_into_a_buffer(key: Any) -> None:
    data = stack_episodes(episodes(), task=0)
    data[key][5] = float("nan")
    with pytest.raises(BMRLError, match=r"is not finite in transition 5; valid: finite"):
        make_replay_buffer(data, batch_size=2)
    with pytest.raises(BMRLError, match="is not finite in transition 5"):
        make_multi_task_replay_buffer([data], batch_size=2)
