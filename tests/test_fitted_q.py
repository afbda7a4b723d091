"""The estimate of fitted Q evaluation is the policy's value, not the demonstrator's."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.fitted_q import estimate_return

STATES = 3


def episodes(reward: float = 1.0) -> TensorDict:
    """Episodes over three states in order; both actions in each, rewarded for the action +1."""
    step = torch.arange(STATES).repeat(2)
    action = torch.tensor([1.0, -1.0]).repeat_interleave(STATES)[:, None]
    one_hot = torch.eye(STATES + 1)
    last = (step == STATES - 1)[:, None]
    after = {
        "observation": one_hot[step + 1],
        "reward": reward * (action > 0).float(),
        "done": last,
        "terminated": last,
    }
    data = {"observation": one_hot[step], "action": action, "step": step, "next": after}
    return TensorDict(data, [2 * STATES])


def policy(*actions: float) -> TensorDictModule:
    """Acts by the number of the state."""
    chosen = torch.tensor([*actions, 0.0])
    return TensorDictModule(
        lambda observation: chosen[observation.argmax(-1, keepdim=True)],
        in_keys=["observation"],
        out_keys=["action"],
    )


@pytest.mark.parametrize(
    ("actions", "value"),
    [((1, 1, 1), 1 + 0.6 + 0.36), ((1, -1, 1), 1 + 0.36), ((-1, -1, -1), 0.0)],
)
def test_the_estimate_is_the_discounted_return_of_the_policy_from_the_starts(
    actions: tuple[float, ...], value: float
) -> None:
    torch.manual_seed(0)
    estimate = estimate_return(
        policy(*actions),
        episodes(),
        updates=300,
        gamma=0.6,
        lr=1e-2,
        batch_size=16,
        num_cells=(32,),
    )
    assert estimate == pytest.approx(value, abs=0.05)


def test_a_critic_that_diverges_is_an_error_that_names_the_evaluation() -> None:
    with pytest.raises(BMRLError, match="of reach, update 2"):
        estimate_return(
            policy(1, 1, 1),
            episodes(),
            updates=2,
            gamma=0.5,
            lr=1e20,
            where="fitted Q evaluation of reach",
        )


def test_every_update_is_reported() -> None:
    reported: list[int] = []
    estimate_return(policy(1, 1, 1), episodes(), updates=3, gamma=0.5, report=reported.append)
    assert reported == [1, 1, 1]


def test_large_rewards_are_estimated_and_do_not_count_as_divergence() -> None:
    value = estimate_return(policy(1.0, 1.0, 1.0), episodes(1e5), updates=3, gamma=0.9)
    assert value == value
