"""Episodes, and the transitions that they become."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_bmrl.data import Episode, stack_episodes
from torchrl_bmrl.data.episodes import RESERVED, LazyEpisodes, as_tensordict
from torchrl_bmrl.errors import BMRLError

LENGTHS = (4, 1, 3)


def episode(number: int, length: int) -> Episode:
    """Each value tells its episode (hundreds) and time; step 1 succeeds."""
    time = 100.0 * number + np.arange(length + 1)
    return Episode(
        observations={"x": time[:-1, None], "y": np.tile(-time[:-1, None], 2)},
        next_observations={"x": time[1:, None], "y": np.tile(-time[1:, None], 2)},
        actions=np.tile(time[:-1, None] / 1000, 7),
        rewards=time[:-1],
        terminated=np.zeros(length, dtype=bool),
        extras={"successes": np.arange(length) == 1},
    )


def episodes() -> list[Episode]:
    return [episode(number, length) for number, length in enumerate(LENGTHS)]


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


def test_an_episode_that_does_not_terminate_ends_by_truncation() -> None:
    data = stack_episodes(episodes(), task=0)
    last = [False, False, False, True, True, False, False, True]
    assert data["next", "truncated"].squeeze(-1).tolist() == last
    assert data["next", "done"].squeeze(-1).tolist() == last
    assert not data["next", "terminated"].any()
    data["next", "done"].zero_()
    assert data["next", "truncated"].any()  # the flags are tensors of their own


def test_an_episode_that_terminates_is_not_truncated() -> None:
    data = as_tensordict(replace(episode(0, 3), terminated=np.array([False, False, True])))
    assert data["next", "terminated"].squeeze(-1).tolist() == [False, False, True]
    assert data["next", "done"].squeeze(-1).tolist() == [False, False, True]
    assert not data["next", "truncated"].any()


def test_discrete_actions_stay_integers() -> None:
    data = as_tensordict(replace(episode(0, 3), actions=np.array([2, 0, 1])))
    assert data["action"].dtype == torch.int64
    assert data["action"].tolist() == [2, 0, 1]


def test_what_an_episode_does_not_have_is_not_made_up() -> None:
    data = as_tensordict(replace(episode(0, 3), extras={}), number=5)
    assert ("next", "success") not in data.keys(True)
    assert data["episode"].tolist() == [5, 5, 5]
    assert "task" not in data


@pytest.mark.parametrize("name", sorted(RESERVED))
def test_a_part_of_the_observation_cannot_take_a_name_of_torchrl_s(name: str) -> None:
    parts = {name: np.zeros((3, 1))}
    wrong = replace(episode(0, 3), observations=parts, next_observations=parts)
    with pytest.raises(BMRLError, match=f"named '{name}'; valid: none of"):
        as_tensordict(wrong)


@pytest.mark.parametrize("name", ["../../evil", "a/b", ".hidden", "..", "", "a\\b"])
def test_a_part_of_the_observation_cannot_be_named_like_a_path(name: str) -> None:
    parts = {name: np.zeros((3, 1))}
    wrong = replace(episode(0, 3), observations=parts, next_observations=parts)
    with pytest.raises(BMRLError, match="valid: a name without slashes"):
        as_tensordict(wrong)


def test_no_episodes_are_refused() -> None:
    with pytest.raises(BMRLError, match="at least one"):
        stack_episodes([], task=0)


def test_lazy_episodes_are_read_when_asked_for_and_in_order() -> None:
    read: list[str] = []

    def reader(name: str) -> Episode:
        read.append(name)
        return episode(int(name[-1]), 2)

    lazy = LazyEpisodes(["demo_2", "demo_0"], reader)
    assert (len(lazy), list(lazy), read) == (2, ["demo_2", "demo_0"], [])
    assert lazy["demo_0"].rewards.tolist() == [0.0, 1.0]
    assert read == ["demo_0"]
    data = stack_episodes(lazy.values(), task=0)
    assert data["next", "reward"].squeeze(-1).tolist() == [200.0, 201.0, 0.0, 1.0]
    with pytest.raises(KeyError):
        lazy["demo_1"]
    assert read == ["demo_0", "demo_2", "demo_0"]
