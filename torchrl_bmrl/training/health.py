"""Detects training that diverged or collapsed, and raises an error that names likely causes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from torchrl_bmrl.errors import BMRLError

LARGEST = 1e8
"""A loss or metric above this value means that the training has diverged, with rewards up to 1."""
EXPLODED = 5.0
"""Values above this multiple of the largest possible return mean that the critic has diverged."""
DEAD = 1e-5
"""Proposals that differ by less than this count as one action."""
SATURATED = 0.99
"""Share of proposed action components at a bound above which the decoder is saturated."""
_SAVED = "the last checkpoint stays"


def largest_metric(*rewards: Tensor) -> float:
    """Returns the bound on losses and metrics: :data:`LARGEST` times the square of the rewards.

    Critics' losses are squares of rewards, or of sums of them.

    Args:
        *rewards: of all data; the largest counts, or 1 if it is below that.

    Example:
        >>> import torch
        >>> largest_metric(torch.tensor([0.5, -10.0]))
        10000000000.0
    """
    return LARGEST * max([1.0, *(reward.abs().max().item() for reward in rewards)]) ** 2


def value_limits(reward: Tensor, gamma: float) -> dict[str, float]:
    """Returns bounds of a critic's metrics: :data:`EXPLODED` times the largest possible return.

    Args:
        reward: rewards of all data; a batch of sparse rewards may have none.
        gamma: discount factor; with 1 there is no bound.

    Example:
        >>> import torch
        >>> value_limits(torch.tensor([0.0, 2.0]), gamma=0.5)
        {'pred_value': 20.0, 'next_state_value': 20.0}
    """
    largest = max(1.0, reward.abs().max().item())
    limit = EXPLODED * largest / (1 - gamma) if gamma < 1 else math.inf
    return {"pred_value": limit, "next_state_value": limit}


def check_metrics(
    metrics: Mapping[str, Any],
    where: str,
    limits: Mapping[str, float] | None = None,
    *,
    largest: float = LARGEST,
) -> None:
    """Raises an error if a loss or value is not finite or too large.

    Args:
        metrics: scalars by name.
        where: the training and the update, for the message.
        limits: bounds on the absolute value of some metrics.
        largest: bound on the others, see :func:`largest_metric`.

    Raises:
        BMRLError: naming the first such metric.

    Example:
        >>> check_metrics({"pred_value": 900.0}, "bcq lift, update 100", {"pred_value": 500.0})
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: bcq lift, update 100: pred_value is 900, above 500; ...
    """
    for name, value in metrics.items():
        number, limit = float(value), (limits or {}).get(name, largest)
        if not math.isfinite(number):
            raise BMRLError(f"{where}: {name} is {number}; {_SAVED}; try a lower learning rate")
        if abs(number) > limit:
            raise BMRLError(
                f"{where}: {name} is {number:.4g}, above {limit:.4g}; the training has diverged; "
                f"{_SAVED}; try a lower learning rate or tau, value_bounds or critic_grad_clip"
            )


def check_proposals(proposals: Tensor, demonstrated: Tensor, where: str) -> None:
    """Raises an error if the generator proposes a single action, or only actions at the bounds.

    Args:
        proposals: actions in [-1, 1], ``(*B, num_candidates, action_dim)``.
        demonstrated: actions of the data, ``(*B, action_dim)``; they may lie at the bounds.
        where: the training and the update, for the message.

    Raises:
        BMRLError: naming the fault and settings that may help.

    Example:
        >>> import torch
        >>> check_proposals(torch.zeros(8, 4, 2), torch.zeros(8, 2), "bcq lift, update 100")
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: bcq lift, update 100: all candidates of a state are equal ...
    """
    at_bound, usual = (
        (actions.abs() > 0.999).float().mean().item() for actions in (proposals, demonstrated)
    )
    if at_bound > SATURATED and usual < 0.9:
        raise BMRLError(
            f"{where}: {at_bound:.0%} of the proposed action components lie at a bound, and "
            f"{usual:.0%} of the demonstrated ones; the decoder is saturated and has no gradient; "
            f"{_SAVED}; try a lower learning rate, or scale the actions to [-1, 1]"
        )
    spread = (proposals.amax(-2) - proposals.amin(-2)).max().item()
    if proposals.shape[-2] > 1 and spread < DEAD:
        raise BMRLError(
            f"{where}: all candidates of a state are equal (they differ by {spread:.1e}); the "
            f"decoder ignores its latent; {_SAVED}; with the autoencoder try a lower kl_weight or "
            "a larger latent_clip"
        )
