"""n-step data: sums, ends of episodes, padding, and the targets that the losses compute of them."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    NO_UPDATER,
    OBSERVATION_DIM,
    discrete_transitions,
    guide,
    make_bcq_loss,
    make_discrete_bcq_loss,
    make_plas_loss,
    total,
    transitions,
)
from tensordict import NonTensorStack, TensorDict, TensorDictBase, lazy_stack
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from torchrl_bmrl.data import NStep, make_replay_buffer
from torchrl_bmrl.errors import BMRLError

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GAMMA = 0.9
LOSSES = {
    "bcq": (make_bcq_loss, transitions),
    "plas": (make_plas_loss, transitions),
    "emaq": (guide().TestEMaQLoss.case.make, transitions),
    "discrete_bcq": (make_discrete_bcq_loss, discrete_transitions),
}
every_loss = pytest.mark.parametrize(("make", "draw"), LOSSES.values(), ids=LOSSES)
WEIGHT = torch.linspace(-1, 2, OBSERVATION_DIM, dtype=torch.float64)


def value(data: TensorDictBase) -> Tensor:
    """Some value of the next states, ``(*B,)``."""
    return data["next", "observation"] @ WEIGHT


def with_random_ends(data: TensorDict, seed: int) -> TensorDict:
    """The data with episodes of a few steps, terminated or truncated."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(*data.batch_size, 1, generator=generator)
    data["next", "terminated"], data["next", "truncated"] = drawn < 0.15, drawn > 0.85
    data["next", "done"] = data["next", "terminated"] | data["next", "truncated"]
    return data


def slow(
    data: TensorDictBase, n: int, gamma: float, next_value: Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rewards, steps and targets of ``[T]`` by two loops over Python numbers."""
    reward, done, terminated = (
        data["next", key].flatten().tolist() for key in ("reward", "done", "terminated")
    )
    rows = []
    for t in range(len(data)):
        summed, k = 0.0, 0
        for i in range(t, min(t + n, len(data))):
            summed, k = summed + gamma**k * reward[i], k + 1
            if done[i]:
                break
        bootstrap = 0.0 if terminated[i] else gamma**k * next_value[i].item()
        rows.append((summed, k, summed + bootstrap))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def equal(a: TensorDictBase, b: TensorDictBase) -> bool:
    keys = set(a.keys(True, True))
    return keys == set(b.keys(True, True)) and all(torch.equal(a[key], b[key]) for key in keys)


def numbered(rows: int, terminated: tuple[int, ...] = (), truncated: tuple[int, ...] = ()) -> Any:
    """Row t has the reward t + 1 and the next observation 10 t."""
    row = torch.arange(rows, dtype=torch.float64).unsqueeze(-1)
    ended, cut = (torch.isin(row, torch.tensor(x).double()) for x in (terminated, truncated))
    after = {"observation": 10 * row, "reward": row + 1, "done": ended | cut}
    return TensorDict({"next": after | {"terminated": ended, "truncated": cut}}, [rows])


def flags(data: TensorDict, key: str) -> list[int]:
    return data["next", key].flatten().nonzero().flatten().tolist()


# -- the equation ----------------------------------------------------------------------------------


def test_rows_and_targets_are_those_computed_by_hand() -> None:
    """Four steps to a termination, three to a truncation, two that are cut off."""
    data = NStep(3, gamma=0.5)(numbered(9, terminated=(3,), truncated=(6,)))
    reward = [1 + 1 + 0.75, 2 + 1.5 + 1, 3 + 2, 4, 5 + 3 + 1.75, 6 + 3.5, 7, 8 + 4.5, 9]
    assert data["next", "reward"].squeeze(-1).tolist() == reward
    assert data["steps_to_next_obs"].squeeze(-1).tolist() == [3, 3, 2, 1, 3, 2, 1, 2, 1]
    after = [20, 30, 30, 30, 60, 60, 60, 80, 80]
    assert data["next", "observation"].squeeze(-1).tolist() == after
    assert flags(data, "terminated") == [1, 2, 3]
    assert flags(data, "truncated") == [4, 5, 6]
    assert flags(data, "done") == [1, 2, 3, 4, 5, 6]
    target = make_bcq_loss(gamma=0.5).td_target(data, torch.full((9,), 16.0).double())
    assert target.tolist() == [2.75 + 2, 4.5, 5, 4, 9.75 + 2, 9.5 + 4, 7 + 8, 12.5 + 4, 9 + 8]


@every_loss
@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_targets_are_those_of_two_loops(make: Any, draw: Any, n: int) -> None:
    loss = make(gamma=GAMMA)
    for seed in range(10):
        data = with_random_ends(draw(30, seed=seed), seed)
        steps = NStep(n, GAMMA)(data)
        reward, k, target = slow(data, n, GAMMA, value(data))
        np.testing.assert_allclose(steps["next", "reward"].flatten(), reward, rtol=1e-13)
        np.testing.assert_array_equal(steps["steps_to_next_obs"].flatten(), k)
        np.testing.assert_allclose(loss.td_target(steps, value(steps)), target, rtol=1e-12)


@every_loss
def test_a_loss_trains_on_samples_of_the_data(make: Any, draw: Any) -> None:
    data = NStep(3, GAMMA)(with_random_ends(draw(30), 0))
    torch.manual_seed(0)
    batch = make_replay_buffer(data, batch_size=16).sample()
    assert set(batch["steps_to_next_obs"].unique().tolist()) == {1, 2, 3}
    total(make(gamma=GAMMA)(batch)).backward()


@pytest.mark.parametrize("shape", [(4, 30), (2, 2, 30), (4, 1)])
def test_rows_of_a_batch_are_apart(shape: tuple[int, ...]) -> None:
    data = with_random_ends(transitions(*shape), 0)
    steps = NStep(3, GAMMA)(data)
    assert steps.batch_size == data.batch_size
    assert steps["steps_to_next_obs"].dtype == torch.int64
    each = torch.stack([NStep(3, GAMMA)(row) for row in data.reshape(-1, shape[-1])])
    assert equal(steps, each.reshape(shape))


def test_one_step_leaves_rewards_and_next_as_they_are() -> None:
    data = with_random_ends(transitions(30), 0)
    steps = NStep(1, GAMMA)(data)
    assert (steps.pop("steps_to_next_obs") == 1).all()
    assert equal(steps, data)


def test_more_steps_than_there_are_give_the_returns_of_whole_episodes() -> None:
    data = numbered(5, terminated=(2,), truncated=(4,))
    for n in (3, 5, 1000):
        steps = NStep(n, gamma=1.0)(data)
        assert steps["next", "reward"].flatten().tolist() == [6, 5, 3, 9, 5]
        assert steps["steps_to_next_obs"].flatten().tolist() == [3, 2, 1, 2, 1]


def test_without_a_discount_the_first_reward_counts() -> None:
    steps = NStep(3, gamma=0.0)(numbered(5))
    assert steps["next", "reward"].flatten().tolist() == [1, 2, 3, 4, 5]
    assert steps["steps_to_next_obs"].flatten().tolist() == [3, 3, 3, 2, 1]


def test_rewards_keep_their_precision() -> None:
    data = transitions(60)
    data["next", "done"].zero_()
    data["next", "terminated"].zero_()
    reward = data["next", "reward"].flatten().tolist()
    exact = math.fsum(0.999**i * reward[i] for i in range(50))
    found = NStep(50, 0.999)(data)["next", "reward"][0].item()
    assert found == pytest.approx(exact, rel=1e-14, abs=1e-14)
    data["next", "reward"] = data["next", "reward"].float()
    assert NStep(50, 0.999)(data)["next", "reward"].dtype == torch.float32


# -- where an episode ends -------------------------------------------------------------------------


def test_a_termination_ends_an_episode_without_done() -> None:
    data = numbered(5, terminated=(2,))
    expected = NStep(3, GAMMA)(data)
    data["next", "done"].zero_()
    steps = NStep(3, GAMMA)(data)
    steps["next", "done"] = expected["next", "done"]
    assert equal(steps, expected)


def test_data_may_do_without_terminated() -> None:
    data = numbered(5, terminated=(2,))
    expected = NStep(3, GAMMA)(data).exclude(("next", "terminated"))
    assert equal(NStep(3, GAMMA)(data.exclude(("next", "terminated"))), expected)


@pytest.mark.parametrize("key", ["episode", ("collector", "traj_ids")])
@pytest.mark.parametrize("width", [None, 1, 2])
def test_another_episode_begins_without_done(key: Any, width: int | None) -> None:
    data = numbered(6)
    number = torch.tensor([[0, 4], [0, 4], [0, 4], [0, 1], [0, 1], [0, 7]])
    data[key] = number[:, -1] if width is None else number[:, -width:]
    steps = NStep(3, gamma=1.0)(data)
    assert steps["next", "reward"].flatten().tolist() == [6, 5, 3, 9, 5, 6]
    assert steps["next", "observation"].flatten().tolist() == [20, 20, 20, 40, 40, 50]
    assert flags(steps, "done") == []  # the loss bootstraps from the last observation of each


def test_episodes_of_rows_of_a_batch_are_told_apart() -> None:
    data = torch.stack([numbered(4), numbered(4)])
    data["episode"] = torch.tensor([[0, 0, 1, 1], [1, 1, 1, 2]])
    steps = NStep(4, GAMMA)(data)["steps_to_next_obs"].squeeze(-1)
    assert steps.tolist() == [[2, 1, 2, 1], [3, 2, 1, 1]]


@pytest.mark.parametrize("key", ["episode", ("collector", "traj_ids")])
def test_padding_ends_an_episode_and_stays_as_it_is(key: Any) -> None:
    data = with_random_ends(transitions(30), 0)
    done = data["next", "done"].flatten()
    data[key] = done.cumsum(0) - done.long()
    data["next", "done"][-1] = data["next", "terminated"][-1] = False  # cut off
    padded = split_trajectories(data, trajectory_key=key)
    mask = padded["mask" if key == "episode" else ("collector", "mask")]
    assert mask[-1].sum() > 1
    assert not mask[-1].all()
    padded["next", "reward"][~mask] = torch.nan
    steps = NStep(4, GAMMA)(padded.exclude(key))
    expected = NStep(4, GAMMA)(data).exclude(key)
    for leaf in expected.keys(True, True):
        assert torch.equal(steps[leaf][mask], expected[leaf]), leaf
    rest = steps[~mask]
    assert (rest["steps_to_next_obs"] == 1).all()
    assert rest["next", "reward"].isnan().all()
    assert not rest["next", "done"].any()


def test_padding_may_lie_before_an_episode() -> None:
    data = numbered(5)
    data["mask"] = torch.tensor([False, False, True, True, True])
    assert NStep(3, GAMMA)(data)["steps_to_next_obs"].flatten().tolist() == [1, 1, 3, 2, 1]


# -- what it takes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("prepare", [TensorDict.copy, TensorDict.lock_, TensorDict.memmap_])
def test_the_data_given_stay_as_they_are(prepare: Callable[[TensorDict], TensorDict]) -> None:
    data = prepare(with_random_ends(transitions(30), 0))
    before = data.clone()
    steps = NStep(3, GAMMA)(data)
    assert equal(data, before)
    steps["next", "observation"].fill_(0)
    steps["next", "reward"].fill_(0)
    assert equal(data, before)


@pytest.mark.parametrize("dim", [0, 1])
def test_data_may_be_stacked_lazily(dim: int) -> None:
    data = with_random_ends(transitions(4, 30), 0)
    before = data.clone()
    steps = NStep(3, GAMMA)(lazy_stack(list(data.unbind(dim)), dim))
    assert equal(steps, NStep(3, GAMMA)(data))
    assert equal(data, before)


def test_what_is_no_tensor_follows() -> None:
    data = torch.stack([numbered(3), numbered(3)])
    data["next", "name"] = NonTensorStack.from_list([["a", "b", "c"], ["d", "e", "f"]])
    steps = NStep(2, GAMMA)(data)
    names = [[steps[i, j]["next", "name"] for j in range(3)] for i in range(2)]
    assert names == [["b", "c", "c"], ["e", "f", "f"]]


def test_renamed_and_nested_keys_are_read_and_written() -> None:
    data = with_random_ends(transitions(30), 0)
    keys = {"reward": ("robot", "prize"), "done": "over", "terminated": ("robot", "dead")}
    renamed = data.clone()
    for old, new in keys.items():
        target = ("next", new) if isinstance(new, str) else ("next", *new)
        renamed.rename_key_(("next", old), target)
    steps = NStep(3, GAMMA, **{f"{old}_key": new for old, new in keys.items()})(renamed)
    loss = make_bcq_loss(gamma=GAMMA)
    loss.set_keys(**keys)
    expected = slow(data, 3, GAMMA, value(data))[2]
    np.testing.assert_allclose(loss.td_target(steps, value(steps)), expected, rtol=1e-12)


class Counter(EnvBase):
    """Counts its steps, which are its rewards; terminates after five."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        return TensorDict({"observation": torch.zeros(1)})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        count = tensordict["observation"] + 1
        done = count >= 5
        after = {"observation": count, "reward": count.clone(), "done": done, "terminated": done}
        return TensorDict(after)

    def _set_seed(self, seed: int | None) -> None:
        pass


def collected(max_steps: int, **options: Any) -> list[TensorDictBase]:
    """Two batches of 11 steps; the first ends within an episode."""
    env = TransformedEnv(Counter(), StepCounter(max_steps=max_steps))
    collector = Collector(env, None, frames_per_batch=11, total_frames=22, **options)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    return batches


@pytest.mark.filterwarnings("ignore:split_trajs=True")
@pytest.mark.parametrize("max_steps", [4, 10])
@pytest.mark.parametrize("split", [False, True])
def test_a_collector_applies_it_to_what_it_collects(max_steps: int, split: bool) -> None:
    plain = collected(max_steps)
    ready = collected(max_steps, postproc=NStep(3, GAMMA), split_trajs=split)
    assert len(plain) == len(ready) == 2
    end = "truncated" if max_steps == 4 else "terminated"
    for before, after in zip(plain, ready, strict=True):
        flat = after[after["collector", "mask"]] if split else after
        reward, k, _ = slow(before, 3, GAMMA, before["next", "observation"])
        np.testing.assert_allclose(flat["next", "reward"].flatten(), reward, rtol=1e-6)
        np.testing.assert_array_equal(flat["steps_to_next_obs"].flatten(), k)
        last = torch.arange(len(before)) + torch.as_tensor(k) - 1
        for key in ("observation", "step_count", "done", end):
            assert torch.equal(flat["next", key], before["next", key][last]), key
        assert flat["next", end].sum() > before["next", end].sum() > 0
    assert not plain[0]["next", "done"][-1]


def test_it_is_copied_with_its_options() -> None:
    step = NStep(3, GAMMA, reward_key="prize")
    data = numbered(5).rename_key_(("next", "reward"), ("next", "prize"))
    assert equal(pickle.loads(pickle.dumps(step))(data), step(data))
    assert repr(step) == "NStep(n_steps=3, gamma=0.9)"
    assert not step.state_dict()


# -- what it refuses -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_steps": 0}, "n_steps is 0; valid: at least 1, an integer"),
        ({"n_steps": -3}, "n_steps is -3; valid: at least 1"),
        ({"n_steps": 2.0}, "n_steps is 2.0; valid: .*an integer"),
        ({"n_steps": True}, "n_steps is True"),
        ({"gamma": 1.01}, "gamma is 1.01; valid: between 0 and 1"),
        ({"gamma": -0.1}, "gamma is -0.1; valid: between 0 and 1"),
        ({"gamma": math.nan}, "gamma is nan"),
        ({"gamma": "0.9"}, "gamma is '0.9'"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        NStep(**{"n_steps": 3, "gamma": GAMMA, **options})


@pytest.mark.parametrize(
    ("key", "given", "message"),
    [
        (("next", "reward"), None, r"no \('next', 'reward'\); they have: .*done"),
        (("next", "done"), None, r"no \('next', 'done'\); they have: .*reward"),
        (
            ("next", "reward"),
            torch.ones(5, 2),
            r"reward'\) has the shape \(5, 2\); valid: \(5, 1\)",
        ),
        (("next", "reward"), torch.ones(5), r"the shape \(5,\); valid: \(5, 1\)"),
        (("next", "reward"), torch.ones(5, 1).long(), r"is torch.int64; valid: floating-point"),
        (("next", "done"), torch.zeros(5).bool(), r"done'\) has the shape \(5,\); valid: \(5, 1\)"),
        (("next", "done"), torch.zeros(5, 1), r"done'\) is torch.float32; valid: torch.bool"),
        (("next", "terminated"), torch.zeros(5, 3).bool(), r"terminated'\) has the shape \(5, 3\)"),
        ("steps_to_next_obs", torch.ones(5, 1), "'steps_to_next_obs' already; valid: .*one step"),
        ("mask", torch.ones(5), r"'mask' is torch.float32 \(5,\); valid: torch.bool \(5,\), False"),
        ("mask", torch.ones(5, 2).bool(), r"'mask' is torch.bool \(5, 2\); valid: .*\(5,\)"),
        ("episode", NonTensorStack(*"aabbb"), "'episode' is a .*; valid: a tensor"),
    ],
)
def test_data_of_another_form_are_refused(key: Any, given: Any, message: str) -> None:
    data = numbered(5)
    data = data.exclude(key) if given is None else data.set(key, given)
    with pytest.raises(BMRLError, match=message):
        NStep(3, GAMMA)(data)


def test_data_without_steps_in_time_are_refused() -> None:
    for data in (numbered(5)[0], numbered(0)):
        with pytest.raises(BMRLError, match=r"batch size \[.*\]; valid: \[\*B, T\] with T >= 1"):
            NStep(3, GAMMA)(data)
