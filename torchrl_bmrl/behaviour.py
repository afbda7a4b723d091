"""Equations of actors that stay near the behaviour of the data."""

from __future__ import annotations

from math import log, pi

import torch
from torch import Tensor
from torch.nn import functional as F


def squashed_gaussian(
    loc: Tensor, scale: Tensor, noise: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Action of a Gaussian that tanh squashes between bounds, and its log-density.

    .. math:: a = a_{low} + h\,(1 + \tanh u), \quad u = \mu + \sigma \epsilon, \quad
        \log \pi(a) = \sum_i \log N(u_i; \mu_i, \sigma_i) - \log h_i - \log(1 - \tanh^2 u_i)

    with :math:`h = (a_{high} - a_{low}) / 2`. TorchRL's ``TanhNormal`` is the same distribution;
    here the caller draws ε, so that a loss can be compiled and run under :func:`torch.vmap`.

    Reference: Haarnoja et al., *Soft Actor-Critic*, ICML 2018, https://arxiv.org/abs/1801.01290,
    appendix C.

    Args:
        loc: μ, ``(*B, action_dim)``.
        scale: σ, likewise, positive.
        noise: ε, likewise, drawn from the standard Gaussian.
        low: lower bound, ``()`` or ``(action_dim,)``.
        high: upper bound, likewise.

    Returns:
        the action ``(*B, action_dim)`` and its log-density ``(*B,)``.

    Example:
        >>> zero, one = torch.zeros(1), torch.ones(1)
        >>> squashed_gaussian(zero, one, zero, -one, one)
        (tensor([0.]), tensor(-0.9189))
    """
    half = (high - low) / 2
    raw = loc + scale * noise
    slope = 2 * (log(2) - raw - F.softplus(-2 * raw))  # log(1 - tanh²), without its cancellation
    density = -0.5 * (noise.square() + log(2 * pi)) - scale.log() - slope
    density = density - torch.where(half > 0, half, 1.0).log()  # equal bounds: no spread
    return low + half * (1 + raw.tanh()), density.sum(-1)


def dual_kl(policy_logit: Tensor, data_logit: Tensor) -> Tensor:
    r"""Estimate of the divergence of a policy's actions from the data's by a trained classifier.

    .. math:: \hat D = 1 + \log \mathrm{softplus}(c(s, a_\pi)) - \mathrm{softplus}(c(s, a))

    Its mean is at most :math:`\mathrm{KL}(\pi \,\|\, \pi_b)`, and equal to it where
    :math:`\mathrm{softplus}(c)` is the ratio of the densities. So c is trained to increase it.

    Reference: Wu et al., *Behavior Regularized Offline Reinforcement Learning*,
    https://arxiv.org/abs/1911.11361, eq. 7.

    Args:
        policy_logit: c at the policy's action, ``(*B,)``.
        data_logit: c at the data's action, ``(*B,)``.

    Returns:
        ``(*B,)``.

    Example:
        >>> c = torch.tensor(1.0).expm1().log()  # whose softplus is 1
        >>> dual_kl(c, c).abs() < 1e-6
        tensor(True)
    """
    return 1 + F.softplus(policy_logit).clamp(min=1e-8).log() - F.softplus(data_logit)


def excess_penalty(logit: Tensor) -> Tensor:
    r"""Penalty on a classifier's output beyond ±1, :math:`\max(0, |c| - 1)^2`.

    Args:
        logit: c, ``(*B,)``.

    Example:
        >>> excess_penalty(torch.tensor([0.5, -3.0]))
        tensor([0., 4.])
    """
    return (logit.abs() - 1).clamp(min=0).square()


def interpolated(one: Tensor, other: Tensor) -> Tensor:
    """A random point between each two, ``(*B, n)``.

    Args:
        one: ``(*B, n)``.
        other: likewise.

    Example:
        >>> between = interpolated(torch.zeros(5, 2), torch.ones(5, 2))
        >>> bool(((between >= 0) & (between <= 1)).all())
        True
    """
    share = torch.rand(one.shape[:-1], dtype=one.dtype, device=one.device).unsqueeze(-1)
    return one + share * (other - one)
