"""Calls of a policy with tensors, and what reaches a live policy before its next call."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import make_bcq_loss
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.modules import BCQPolicy, PLASPolicy, make_decoder


class FromPicture(nn.Module):
    """A latent computed from a picture ``(*B, 3, 8, 8)``."""

    def forward(self, picture: Tensor) -> Tensor:
        return picture.mean((-1, -2))


@pytest.fixture
def policy() -> PLASPolicy:
    """It reads a picture, whose size no network declares, and an observation of a declared size."""
    actor = TensorDictModule(FromPicture(), in_keys=["picture"], out_keys=["action_latent"])
    torch.manual_seed(0)
    return PLASPolicy(actor, make_decoder(4, 2, 3))


@pytest.mark.parametrize("batch", [(), (5,)])
@pytest.mark.parametrize("first", ["picture", "observation"])
def test_a_picture_and_an_observation_have_one_batch(
    policy: PLASPolicy, batch: tuple[int, ...], first: str
) -> None:
    policy.in_keys = sorted(policy.in_keys, key=lambda key: key != first)
    state: dict[str, Any] = {
        "picture": torch.rand(*batch, 3, 8, 8),
        "observation": torch.randn(*batch, 4),
    }
    expected = policy(TensorDict(state, batch))["action"]
    assert expected.shape == (*batch, 2)
    assert torch.equal(policy(**state), expected)
    assert torch.equal(policy(*(state[key] for key in policy.in_keys)), expected)


def test_a_coefficient_that_comes_or_goes_reaches_a_live_policy_at_once() -> None:
    """A compiled policy does not follow its loss at a call."""
    loss = make_bcq_loss(latent_clip=0.5)
    policy = BCQPolicy.live(loss)
    loss.latent_clip = None
    assert policy.latent_clip is None
    loss.latent_clip = 0.25
    assert float(policy.latent_clip) == 0.25
