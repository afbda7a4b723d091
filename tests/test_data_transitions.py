"""The next action of a transition, and the best episodes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import refused
from tensordict import TensorDict

from torchrl_bmrl.data import NStep, best_episodes, make_replay_buffer, with_next_action
from torchrl_bmrl.errors import BMRLError


def episodes(*lengths: int, terminated: tuple[int, ...] = (), rewards: Any = None) -> TensorDict:
    """Episodes one after the other, whose actions count all steps; ends are truncations."""
    steps = sum(lengths)
    number = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    done, ended = torch.zeros(steps, 1, dtype=torch.bool), torch.zeros(steps, 1, dtype=torch.bool)
    for i in range(len(lengths)):
        last = sum(lengths[: i + 1]) - 1
        done[last] = True
        ended[last] = i in terminated
    reward = torch.zeros(steps) if rewards is None else torch.tensor(rewards)
    after = {"done": done, "terminated": ended, "reward": reward.unsqueeze(-1)}
    after["observation"] = torch.arange(1.0, steps + 1).unsqueeze(-1)
    action = torch.arange(float(steps)).unsqueeze(-1)
    data = {"episode": number, "action": action, "observation": action.clone(), "next": after}
    return TensorDict(data, [steps])


def pairs(data: TensorDict) -> list[tuple[float, float]]:
    both = (data["action"].flatten().tolist(), data["next", "action"].flatten().tolist())
    return list(zip(*both, strict=True))


# -- the next action -------------------------------------------------------------------------------


def test_the_next_action_is_that_of_the_next_step_of_the_episode() -> None:
    data = with_next_action(episodes(3, 2))
    assert pairs(data) == [(0, 1), (1, 2), (3, 4)]
    assert data["next", "observation"].flatten().tolist() == [1, 2, 4]  # rows stay whole


def test_a_truncated_last_step_is_left_out_and_a_terminated_one_stays() -> None:
    assert pairs(with_next_action(episodes(2, 2, terminated=(0,)))) == [(0, 1), (1, 1), (2, 3)]


def test_data_that_are_cut_off_lose_their_last_step() -> None:
    data = episodes(3)
    data["next", "done"][-1] = False
    assert pairs(with_next_action(data)) == [(0, 1), (1, 2)]


def test_an_episode_cut_off_without_a_flag_ends_where_its_number_changes() -> None:
    data = episodes(2, 2)
    data["next", "done"][:] = False
    assert pairs(with_next_action(data)) == [(0, 1), (2, 3)]


def test_an_episode_that_lost_its_last_step_ends_before_it_for_n_steps_too() -> None:
    """Without a number of the episode, only its flags tell where it ends."""
    data = episodes(4, 3, terminated=(1,), rewards=[1.0] * 7).exclude("episode")
    after = data["next"]
    after["truncated"] = after["done"] & ~after["terminated"]
    pairs_of_actions = with_next_action(data)
    assert pairs_of_actions["next", "done"].flatten().tolist() == [0, 0, 1, 0, 0, 1]
    assert pairs_of_actions["next", "truncated"].flatten().tolist() == [0, 0, 1, 0, 0, 0]
    assert not after["done"][2]  # the given data stay
    n_step = NStep(3, gamma=1.0)(pairs_of_actions)
    assert n_step["next", "reward"].flatten().tolist() == [3, 2, 1, 3, 2, 1]
    assert n_step["next", "action"].flatten().tolist() == [3, 3, 3, 6, 6, 6]


@pytest.mark.parametrize("change", [with_next_action, best_episodes])
def test_rows_of_several_steps_are_refused(change: Any) -> None:
    """The next action would be one too early, and a return would count rewards repeatedly."""
    with refused("the data have 'steps_to_next_obs' already; valid: transitions of one step"):
        change(NStep(2, gamma=1.0)(episodes(3, 3)))


def test_the_given_data_do_not_change() -> None:
    data = episodes(3)
    before = data.clone()
    with_next_action(data)
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()


def test_the_next_action_has_another_name_if_the_action_has() -> None:
    data = with_next_action(episodes(3).rename_key_("action", "move"), "move")
    assert data["next", "move"].flatten().tolist() == [1, 2]


def test_a_replay_buffer_takes_transitions_with_next_actions() -> None:
    sample = make_replay_buffer(with_next_action(episodes(3, 3)), batch_size=16).sample()
    assert torch.equal(sample["next", "action"], sample["action"] + 1)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (episodes(2).unsqueeze(0), r"batch size \[1, 2\]; valid: \[N\]"),
        (episodes(2).exclude("action"), "no 'action'; they have"),
        (episodes(2).exclude(("next", "done")), "no .*'done'.*; they have"),
        (episodes(1, 1), "no transition has a next action; valid: episodes of two steps"),
    ],
)
def test_data_without_next_actions_are_refused(data: TensorDict, says: str) -> None:
    with refused(says):
        with_next_action(data)


# -- the best episodes -----------------------------------------------------------------------------


def chosen(data: TensorDict, share: float) -> list[int]:
    return best_episodes(data, share)["episode"].unique().tolist()


def test_the_best_episodes_are_those_with_the_largest_returns_and_not_the_largest_rewards() -> None:
    data = episodes(2, 1, 3, rewards=[4.0, 4.0, 5.0, 3.0, 3.0, 3.0])
    assert chosen(data, 1 / 3) == [2]
    assert chosen(data, 2 / 3) == [0, 2]
    assert best_episodes(data, 2 / 3)["action"].flatten().tolist() == [0, 1, 3, 4, 5]


def test_episodes_of_two_data_sets_with_one_number_are_refused() -> None:
    """Their returns would be added up."""
    after = TensorDict({"reward": torch.ones(4, 1)}, [4])
    steps = {"episode": torch.tensor([0, 0, 1, 1]), "step": torch.tensor([0, 1, 0, 1])}
    data = TensorDict(steps | {"next": after}, [4])
    assert len(best_episodes(data, share=0.5)) == 2
    with pytest.raises(BMRLError, match=r"episode 0 has step 0 2 times; valid: .*number_episodes"):
        best_episodes(torch.cat([data, data]))


def test_at_least_one_episode_is_chosen_and_at_most_all() -> None:
    data = episodes(1, 1, 1, rewards=[0.0, 2.0, 1.0])
    assert chosen(data, 0.0) == chosen(data, 0.1) == [1]
    assert chosen(data, 1.0) == [0, 1, 2]


def test_of_equal_returns_the_earlier_episodes_are_chosen() -> None:
    assert chosen(episodes(1, 1, 1, 1, rewards=[1.0, 1.0, 1.0, 1.0]), 0.5) == [0, 1]


def test_a_return_is_summed_exactly() -> None:
    # In float32 adding 1e-9 to 1 changes nothing.
    data = episodes(2, 2, rewards=[1.0, 0.0, 1.0, 1e-9])
    assert chosen(data, 0.5) == [1]


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan"), "half"])
def test_a_share_that_is_none_is_refused(share: Any) -> None:
    with refused("share is .*; valid: between 0 and 1"):
        best_episodes(episodes(2), share)


@pytest.mark.parametrize("key", ["episode", ("next", "reward")])
def test_data_without_episodes_or_rewards_are_refused(key: Any) -> None:
    with refused("the data have no .*; they have"):
        best_episodes(episodes(2).exclude(key))
