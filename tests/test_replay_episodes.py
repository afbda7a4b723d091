"""Neither a predecessor, a slice nor an n-step return joins two episodes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from replay_buffers import episodes
from tensordict import TensorDict
from torchrl.data import SliceSampler, TensorDictReplayBuffer

from torchrl_bmrl.data import (
    make_mixed_replay_buffer,
    make_multi_task_replay_buffer,
    make_replay_buffer,
    replay,
    with_previous,
)
from torchrl_bmrl.data.n_step import NStep
from torchrl_bmrl.errors import BMRLError

# -- the previous transition -----------------------------------------------------------------------


def test_the_previous_transition_is_of_the_same_episode() -> None:
    keys = ["x", "action", ("next", "reward"), ("next", "x"), "episode", "step"]
    data = episodes()
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


@pytest.mark.parametrize("rows", [slice(1, None), slice(2, 7), slice(None, None, 2)])
def test_a_transition_whose_previous_one_is_not_there_is_its_own(rows: slice) -> None:
    data = episodes()[rows]
    result = with_previous(data, ["x", "episode", "step"])
    own = result["previous", "step"] == data["step"]
    assert own[0]  # the first row has no predecessor
    assert torch.equal(result["previous", "episode"], data["episode"])
    assert torch.equal(result["previous", "step"][~own], data["step"][~own] - 1)


def test_the_previous_transition_of_two_files_one_after_the_other_is_of_the_same() -> None:
    # By its steps, the second file continues the last episode of the first.
    first, second = episodes()[:2], episodes()[2:]
    second["episode"] = second["episode"] + 3
    result = with_previous(torch.cat([first, second]), ["episode", "step"])
    assert result["previous", "step"].tolist() == [0, 0, 2, 2, 0, 0, 0, 1]


# -- episodes of several data sets -----------------------------------------------------------------


def files() -> list[TensorDict]:
    """Files whose episodes are all numbered from 0; ``file`` tells them apart."""
    found = []
    for number in range(3):
        data = episodes()
        data["file"] = torch.full((8,), number)
        data["next", "done"] = data["step"].roll(-1).eq(0).unsqueeze(-1)
        data["collector", "traj_ids"] = data["episode"].clone()
        found.append(with_previous(data, ["x", "file", "episode"]))
    return found


def joined(buffer: TensorDictReplayBuffer) -> TensorDict:
    return buffer[:].to_tensordict()


@pytest.mark.parametrize("make", [make_multi_task_replay_buffer, make_mixed_replay_buffer])
def test_episodes_of_several_data_sets_have_numbers_of_their_own(make: Any) -> None:
    data = files()
    before = [part.clone() for part in data]
    stored = joined(make(data, weights=[1, 1, 1], batch_size=4))
    assert stored["episode"].tolist() == [
        3 * i + e for i in range(3) for e in [0] * 4 + [1] + [2] * 3
    ]
    assert torch.equal(stored["collector", "traj_ids"], stored["episode"])
    assert torch.equal(stored["previous", "episode"], stored["episode"])
    assert stored["episode"].dtype == torch.int64
    for part, kept in zip(data, before, strict=True):
        assert (part == kept).all()


def test_one_data_set_keeps_the_numbers_of_its_episodes() -> None:
    data = episodes()
    data["episode"] += 5
    assert torch.equal(joined(make_replay_buffer(data, batch_size=4))["episode"], data["episode"])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([[0, 1], [2, 3]], [[0, 1], [2, 3]]),  # distinct already
        ([[7, 9], [0, 1], [0, 1]], [[7, 9], [10, 11], [12, 13]]),
        ([[0, 5], [5, 6], [100]], [[0, 5], [6, 7], [100]]),
        ([[-2, -1], [-2, -1]], [[-2, -1], [0, 1]]),
    ],
)
def test_episode_numbers_stay_where_they_collide_with_none(given: Any, expected: Any) -> None:
    parts = [TensorDict({"episode": torch.tensor(numbers)}, [len(numbers)]) for numbers in given]
    assert [part["episode"].tolist() for part in replay.number_episodes(parts)] == expected


def test_numbers_that_do_not_fit_their_type_are_refused() -> None:
    number = torch.tensor([0, 200], dtype=torch.uint8)
    data = TensorDict({"episode": number}, [2])
    with pytest.raises(BMRLError, match=r"data set 1: .*'episode'.* is torch.uint8; valid: .* 401"):
        make_mixed_replay_buffer([data, data], weights=[1, 1], batch_size=2)


def test_slices_never_join_two_data_sets() -> None:
    data = [part[part["episode"] == 2] for part in files()]  # one episode each
    storage = make_mixed_replay_buffer(data, weights=[1, 1, 1], batch_size=4).storage
    sampler = SliceSampler(slice_len=3, traj_key="episode")
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=30)
    seen = set()
    for _ in range(30):
        slices = buffer.sample().reshape(10, 3)
        for key in ("file", "episode"):
            assert (slices[key] == slices[key][:, :1]).all()
        assert (slices["step"].diff(dim=1) == 1).all()
        seen.update(slices["file"].unique().tolist())
    assert seen == {0, 1, 2}


@pytest.mark.parametrize("key", ["episode", ("collector", "traj_ids")])
def test_n_steps_never_join_two_data_sets(key: Any) -> None:
    data = [part.select("file", "next", key) for part in (x[4:5] for x in files())]
    for part in data:
        part["next", "done"].zero_()  # cut off: only the number shows that another episode begins
    stored = joined(make_mixed_replay_buffer(data, weights=[1, 1, 1], batch_size=4))
    assert NStep(3, 0.9)(stored)["steps_to_next_obs"].flatten().tolist() == [1, 1, 1]
    collided = torch.cat([part.copy() for part in data])
    assert NStep(3, 0.9)(collided)["steps_to_next_obs"].flatten().tolist() == [3, 2, 1]
