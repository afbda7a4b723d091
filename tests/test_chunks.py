"""Chunks of actions: data, and the policy that plays them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import Compose, GymEnv, InitTracker, StepCounter, TransformedEnv

from torchrl_bmrl.data import ActionChunks
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import ActionFlow, ChunkPolicy, make_qvalue_network
from torchrl_bmrl.objectives import BCQLoss


def episodes(*lengths: int, terminated: bool = False) -> TensorDict:
    """Episodes in a row; action t of episode e is (10 e + t, -(10 e + t))."""
    number = torch.cat([torch.full((n,), e) for e, n in enumerate(lengths)])
    time = torch.cat([torch.arange(n) for n in lengths])
    last = torch.cat([torch.arange(n) == n - 1 for n in lengths]).unsqueeze(-1)
    value = (10 * number + time).float().unsqueeze(-1)
    ended = last & terminated
    after = {"observation": value + 1, "reward": value, "done": last, "terminated": ended}
    data = {"observation": value, "action": torch.cat([value, -value], -1), "episode": number}
    return TensorDict(data | {"next": after}, [len(number)])


def test_a_row_has_its_action_and_those_that_follow_in_its_episode() -> None:
    data = ActionChunks(3, gamma=0.5)(episodes(5, 4))
    assert data["action"][:, 0::2].tolist() == [
        [0, 1, 2],
        [1, 2, 3],
        [2, 3, 4],
        [10, 11, 12],
        [11, 12, 13],
    ]
    assert torch.equal(data["action"][:, 1::2], -data["action"][:, 0::2])


def test_its_outcome_is_that_of_all_its_steps() -> None:
    data = ActionChunks(3, gamma=0.5)(episodes(5))
    assert data["next", "reward"][1].item() == 1 + 0.5 * 2 + 0.25 * 3
    assert data["next", "observation"].flatten().tolist() == [3, 4, 5]
    assert data["steps_to_next_obs"].flatten().tolist() == [3, 3, 3]


def test_rows_with_too_few_steps_left_are_dropped_unless_the_episode_terminates() -> None:
    assert len(ActionChunks(3, gamma=0.5)(episodes(5, 2))) == 3
    data = ActionChunks(3, gamma=0.5)(episodes(5, 2, terminated=True))
    assert len(data) == 7
    assert data["action"][3:5, 0::2].tolist() == [[3, 4, 4], [4, 4, 4]]
    assert data["steps_to_next_obs"][3:5].flatten().tolist() == [2, 1]
    assert data["next", "terminated"].flatten().tolist() == [0, 0, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("padding", [False, True])
def test_padded_rows_are_no_chunks(size: int, padding: bool) -> None:
    """Whatever their flags say."""
    data = episodes(5)
    data["mask"] = torch.tensor([True, True, True, False, False])
    data["next", "terminated"][3:] = padding
    assert len(ActionChunks(size, gamma=0.5)(data)) == 4 - size


def test_data_without_any_chunk_are_refused_by_the_size() -> None:
    with pytest.raises(BMRLError, match="size is 6, and the longest episode has 5 steps; valid"):
        ActionChunks(6, gamma=0.5)(episodes(5, 2))


def test_a_policy_that_writes_another_action_is_refused_by_its_keys() -> None:
    inner = TensorDictModule(nn.Identity(), ["observation"], [("agent", "move")])
    state = TensorDict({"observation": torch.zeros(2, 4)}, [2])
    with pytest.raises(BMRLError, match=r"the policy writes \[\('agent', 'move'\)\], not 'action'"):
        ChunkPolicy(inner, 2)(state)
    assert ChunkPolicy(inner, 2, action_key=("agent", "move"))(state)["agent", "move"].shape == (
        2,
        2,
    )


def test_chunks_of_one_action_change_nothing() -> None:
    before = episodes(3, 2)
    data = ActionChunks(1, gamma=0.5)(before)
    for key in ("action", ("next", "reward"), ("next", "observation")):
        assert torch.equal(data[key], before[key])


def test_data_without_an_action_are_refused() -> None:
    with pytest.raises(BMRLError, match="'action'"):
        ActionChunks(2, gamma=0.5)(episodes(3).exclude("action"))


def test_a_loss_over_chunks_discounts_by_all_their_steps() -> None:
    data = ActionChunks(3, gamma=0.9)(episodes(6))
    data["action"] = data["action"] / 100
    loss = BCQLoss(
        ActionFlow(1, 6, num_cells=(8,)),
        [make_qvalue_network(1, 6, num_cells=(8,)) for _ in range(2)],
        bounds=(-1.0, 1.0),
        gamma=0.9,
    )
    _, metrics = loss.qvalue_loss(data)
    expected = data["next", "reward"].mean() + 0.9**3 * metrics["next_state_value"]
    torch.testing.assert_close(metrics["target_value"], expected)


class _Counting(TensorDictModuleBase):
    """Writes chunks of three actions: 3 k, 3 k + 1, 3 k + 2 at its k-th call, times the scale."""

    in_keys, out_keys = ("observation",), ("action",)

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__()
        self.calls, self.scale = 0, scale

    def forward(self, tensordict: TensorDict) -> TensorDict:
        chunk = self.scale * (3 * self.calls + torch.arange(3.0))
        self.calls += 1
        return tensordict.set("action", chunk.expand(*tensordict.batch_size, 3).clone())


def test_a_rollout_plays_each_chunk_to_its_end() -> None:
    pytest.importorskip("gymnasium")
    env = GymEnv("Pendulum-v1")
    inner = _Counting(scale=0.05)
    data = env.rollout(8, ChunkPolicy(inner, 3))
    assert inner.calls == 3
    torch.testing.assert_close(data["action"].flatten(), 0.05 * torch.arange(8.0))


def test_rows_of_a_batch_end_their_chunks_and_episodes_independently() -> None:
    policy = ChunkPolicy(_Counting(), 3)
    data = TensorDict({"observation": torch.zeros(2, 1)}, [2])
    played: list[list[float]] = []
    for step in range(5):
        data["is_init"] = torch.tensor([[step == 0], [step in (0, 2)]])
        data = policy(data)
        played.append(data["action"].flatten().tolist())
    # The second row starts anew at step 2, with the second chunk; the first one at step 3.
    assert played == [[0, 0], [1, 1], [2, 3], [6, 4], [7, 5]]


def test_an_environment_that_resets_by_itself_starts_a_new_chunk() -> None:
    pytest.importorskip("gymnasium")
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(StepCounter(max_steps=4), InitTracker()))
    data = env.rollout(8, ChunkPolicy(_Counting(scale=0.01), 3), break_when_any_done=False)
    played = (100 * data["action"]).round().flatten().tolist()
    assert played == [0, 1, 2, 3, 6, 7, 8, 9]


@pytest.mark.parametrize("size", [0, 4])
def test_sizes_that_do_not_fit_are_refused(size: int) -> None:
    inner = TensorDictModule(nn.Linear(1, 6), ["observation"], ["action"])
    state: Tensor = torch.zeros(2, 1)
    with pytest.raises(BMRLError, match=r"valid: at least 1|a multiple of size, 4"):
        ChunkPolicy(inner, size)(TensorDict({"observation": state}, [2]))
