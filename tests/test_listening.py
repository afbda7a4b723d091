"""Whether a policy listens to m: two deaf policies, one that only listens, and one in between."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.listening import measure_listening

KEYS = (["observation", "task_latent"], ["action"])


def policy(function: Any) -> TensorDictModule:
    return TensorDictModule(function, *KEYS)


def points(number: int, seed: int = 0) -> Tensor:
    return torch.randn(number, 2, generator=torch.Generator().manual_seed(seed))


def test_a_policy_that_ignores_m_has_no_share() -> None:
    found = measure_listening(policy(lambda s, m: s), points(6), points(3))
    assert found.by_latent == found.share == 0
    assert found.by_state > 0


def test_a_policy_that_only_listens_has_the_whole_share() -> None:
    found = measure_listening(policy(lambda s, m: m), points(6), points(3))
    assert found.by_state == 0
    assert found.share == 1


def test_a_policy_that_does_nothing_has_no_share() -> None:
    assert measure_listening(policy(lambda s, m: 0 * s), points(6), points(3)).share == 0


def test_the_numbers_are_mean_squared_differences_of_pairs() -> None:
    states, latents = points(5).double(), points(4, seed=1).double()
    found = measure_listening(policy(lambda s, m: 2 * s * m), states, latents)
    actions = 2 * states[None] * latents[:, None]  # (K, N, 2)

    def pairs(x: Tensor) -> float:
        """Root mean square distance over all ordered pairs of the first dimension."""
        numbers = range(len(x))
        rows = [(x[i] - x[j]).square().sum(-1) for i in numbers for j in numbers if i != j]
        return torch.stack(rows).mean().sqrt().item()

    assert found.by_latent == pytest.approx(pairs(actions))
    assert found.by_state == pytest.approx(pairs(actions.transpose(0, 1)))
    squares = found.by_latent**2, found.by_state**2
    assert found.share == pytest.approx(squares[0] / sum(squares))


def test_random_numbers_are_the_same_for_every_m_and_leave_the_generator_alone() -> None:
    noisy = policy(lambda s, m: s + torch.randn_like(s))
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    found = measure_listening(noisy, points(6), points(3))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert found.by_latent == 0
    assert measure_listening(noisy, points(6), points(3)) == found
    assert measure_listening(noisy, points(6), points(3), seed=1) != found


def test_the_unit_of_the_actions_does_not_change_the_share() -> None:
    def acting(scale: float) -> TensorDictModule:
        return policy(lambda s, m: scale * (s + m))

    one, ten = (measure_listening(acting(scale), points(6), points(3)) for scale in (1.0, 10.0))
    assert ten.share == pytest.approx(one.share)
    assert ten.by_latent == pytest.approx(10 * one.by_latent, rel=1e-5)


@pytest.mark.parametrize(
    ("states", "latents", "says"),
    [
        (points(1), points(3), "1 states and 3 points m; valid: at least two each"),
        (points(6), points(1), "6 states and 1 points m; valid: at least two each"),
        (points(6), points(3)[0], r"task_latents has shape \(2,\); valid"),
        (points(6)[None], points(3), r"observation has shape \(1, 6, 2\); valid"),
    ],
)
def test_too_few_points_and_other_shapes_are_refused(
    states: Tensor, latents: Tensor, says: str
) -> None:
    with pytest.raises(BMRLError, match=says):
        measure_listening(policy(lambda s, m: s), states, latents)


def test_a_policy_that_diverged_has_no_share() -> None:
    with pytest.raises(BMRLError, match="not finite"):
        measure_listening(policy(lambda s, m: s / 0), points(6), points(3))
