"""Training that goes wrong: found at the next logged update, and named with what may be the cause.

Example:
    >>> check_metrics({"loss_qvalue": float("nan")}, "bcq lift, update 100")
    Traceback (most recent call last):
    ...
    torchrl_bmrl.errors.BMRLError: bcq lift, update 100: loss_qvalue is nan; ...
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from torchrl_bmrl.errors import BMRLError

LARGEST = 1e8
"""No loss or metric is as large in a training that goes well."""
EXPLODED = 5.0
"""Values are no estimates any more beyond so many times what any policy can earn."""
DEAD = 1e-5
"""Proposals that differ by less are one action."""
SATURATED = 0.99
"""Share of components at a bound, in proposals of a decoder that is stuck there."""
_KEPT = "the last checkpoint is kept"


def value_limits(reward: Tensor, gamma: float) -> dict[str, float]:
    """Bounds of a critic's metrics: :data:`EXPLODED` times the largest return that there can be.

    Args:
        reward: of a batch.
        gamma: discount factor; nothing bounds the returns of 1.

    Example:
        >>> import torch
        >>> value_limits(torch.tensor([0.0, 2.0]), gamma=0.5)
        {'pred_value': 20.0, 'next_state_value': 20.0}
    """
    largest = max(1.0, reward.abs().max().item())  # a batch of a sparse reward may hold none
    limit = EXPLODED * largest / (1 - gamma) if gamma < 1 else math.inf
    return {"pred_value": limit, "next_state_value": limit}


def check_metrics(
    metrics: Mapping[str, Any], where: str, limits: Mapping[str, float] | None = None
) -> None:
    """Stops a run whose losses or values are not finite any more, or too large to be true.

    Args:
        metrics: scalars by name.
        where: what is trained, and its update.
        limits: bounds on the absolute value of some; :data:`LARGEST` holds for the others.

    Raises:
        BMRLError: naming the first such metric.

    Example:
        >>> check_metrics({"pred_value": 900.0}, "bcq lift, update 100", {"pred_value": 500.0})
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: bcq lift, update 100: pred_value is 900, beyond 500; ...
    """
    for name, value in metrics.items():
        number, limit = float(value), (limits or {}).get(name, LARGEST)
        if not math.isfinite(number):
            raise BMRLError(f"{where}: {name} is {number}; {_KEPT}, a lower learning rate may help")
        if abs(number) > limit:
            raise BMRLError(
                f"{where}: {name} is {number:.4g}, beyond {limit:.4g}; it explodes, as when "
                f"critics chase their own targets. {_KEPT.capitalize()}; a lower learning rate or "
                "tau, value_bounds or critic_grad_clip may help"
            )


def check_proposals(proposals: Tensor, demonstrated: Tensor, where: str) -> None:
    """Stops a run whose generator proposes one action, or the bounds alone.

    Args:
        proposals: actions in [-1, 1], ``(*B, num_candidates, action_dim)``.
        demonstrated: actions of the data, ``(*B, action_dim)``; they may lie at the bounds.
        where: what is trained, and its update.

    Raises:
        BMRLError: naming what is wrong.

    Example:
        >>> import torch
        >>> check_proposals(torch.zeros(8, 4, 2), torch.zeros(8, 2), "bcq lift, update 100")
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: bcq lift, update 100: all candidates of a state are one ...
    """
    at_bound, usual = (
        (actions.abs() > 0.999).float().mean().item() for actions in (proposals, demonstrated)
    )
    if at_bound > SATURATED and usual < 0.9:
        raise BMRLError(
            f"{where}: {at_bound:.0%} of the proposed actions' components lie at a bound, of the "
            f"demonstrations' {usual:.0%}; the decoder is saturated, and no gradient frees it. "
            f"{_KEPT.capitalize()}; a lower learning rate, or actions scaled to [-1, 1] may help"
        )
    spread = (proposals.amax(-2) - proposals.amin(-2)).max().item()
    if proposals.shape[-2] > 1 and spread < DEAD:
        raise BMRLError(
            f"{where}: all candidates of a state are one action (they differ by {spread:.1e}), so "
            "that the critic has nothing to choose from; the decoder does not heed its latent. "
            f"{_KEPT.capitalize()}; a lower kl_weight, or a larger latent_clip may help"
        )
