r"""The equations of the losses, each as one function of plain tensors.

Leading dimensions are written ``*B``. Every function is differentiable in its tensor arguments.

References:
    BCQ: Fujimoto et al., *Off-Policy Deep Reinforcement Learning without Exploration*, ICML 2019,
    https://arxiv.org/abs/1812.02900.
    Discrete BCQ: Fujimoto et al., *Benchmarking Batch Deep Reinforcement Learning Algorithms*,
    2019, https://arxiv.org/abs/1910.01708.
    Meta-distillation: *Compositional Skill Learning Using Batch Meta RL*, section 6.2.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def gaussian_kl(loc: Tensor, scale: Tensor) -> Tensor:
    r"""Kullback-Leibler divergence from a diagonal Gaussian to the standard one, per dimension.

    .. math:: \mathrm{KL} = \tfrac12 (\mu^2 + \sigma^2 - 1) - \log\sigma

    Reference: Kingma and Welling, *Auto-Encoding Variational Bayes*, ICLR 2014,
    https://arxiv.org/abs/1312.6114, appendix B.

    Args:
        loc: mean, ``(*B, latent_dim)``.
        scale: standard deviation, ``(*B, latent_dim)``, positive.

    Returns:
        ``(*B, latent_dim)``; the caller sums or averages over the last dimension.

    Example:
        >>> gaussian_kl(torch.zeros(2), torch.ones(2))
        tensor([0., 0.])
    """
    return 0.5 * (loc.square() + scale.square() - 1.0) - scale.log()


def sample_action_latent(
    shape: torch.Size | tuple[int, ...],
    *,
    latent_clip: float | Tensor | None,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    r"""Draws the VAE's latent for action proposals, z ~ N(0, I) clipped to ± ``latent_clip``.

    The draw is explicit because inside a TorchRL loss a probabilistic module returns its mean, so
    that all proposals would be equal.

    Reference: BCQ.

    Args:
        shape: shape of the sample, ``(*B, latent_dim)``.
        latent_clip: the bound, above 0; ``None`` for none.
        device: of the sample.
        dtype: of the sample.

    Returns:
        z, of the given shape.

    Example:
        >>> z = sample_action_latent((1000, 14), latent_clip=0.5)
        >>> z.abs().max().item() <= 0.5, z.std().item() > 0.3
        (True, True)
    """
    latent = torch.randn(shape, device=device, dtype=dtype)
    if latent_clip is None:
        return latent
    bound = torch.as_tensor(latent_clip, device=device, dtype=dtype)
    return latent.clamp(-bound, bound)


def perturbed_action(
    action: Tensor,
    perturbation: Tensor,
    max_perturbation: float | Tensor,
    low: Tensor,
    high: Tensor,
) -> Tensor:
    r"""Action plus the output of the perturbation network, clipped to the action's bounds.

    .. math:: a' = \mathrm{clip}(a + \phi\, h\, \xi(s, a),\ a_{low},\ a_{high}),\quad
              h = (a_{high} - a_{low}) / 2

    Reference: BCQ, algorithm 1; as in the published code, φ is a share of half the action's range,
    here in each dimension.

    Args:
        action: a, ``(*B, action_dim)``.
        perturbation: ξ in [-1, 1], ``(*B, action_dim)``.
        max_perturbation: φ, at least 0; in units of half the range.
        low: lower bound, ``()`` or ``(action_dim,)``.
        high: upper bound, likewise.

    Returns:
        ``(*B, action_dim)``.

    Example:
        >>> low, high = torch.tensor(-1.0), torch.tensor(1.0)
        >>> perturbed_action(torch.tensor([0.98]), torch.tensor([1.0]), 0.05, low, high)
        tensor([1.])
    """
    return (action + max_perturbation * (0.5 * (high - low)) * perturbation).clamp(low, high)


def soft_clipped_value(state_action_value: Tensor, lmbda: float | Tensor) -> Tensor:
    r"""Soft clipped double-Q: a weighted mean of the ensemble's minimum and maximum.

    .. math:: \lambda \min_j Q_j + (1 - \lambda) \max_j Q_j

    Reference: BCQ, eq. 13.

    Args:
        state_action_value: Q of each critic, ``(num_qvalue_nets, *B)``.
        lmbda: λ in [0, 1].

    Returns:
        ``(*B,)``.

    Example:
        >>> soft_clipped_value(torch.tensor([[1.0], [3.0]]), 0.75)
        tensor([1.5000])
    """
    return lmbda * state_action_value.amin(0) + (1.0 - lmbda) * state_action_value.amax(0)


TARGET_RULES = ("clipped", "mean")
"""Rules by which an ensemble of critics values the next state's actions in BCQ's target."""
ACTING_RULES = ("first", "mean", "min")
"""Rules by which an ensemble values the actions that a policy chooses among."""


def ensemble_value(state_action_value: Tensor, rule: str) -> Tensor:
    r"""Value of an action by an ensemble of critics, for a policy that chooses among actions.

    ===========  =======================================================================
    ``"first"``  :math:`Q_1`, as BCQ and the paper act
    ``"mean"``   :math:`\frac{1}{K}\sum_j Q_j`, whose error is smaller than one critic's
    ``"min"``    :math:`\min_j Q_j`, which avoids actions that the critics disagree on
    ===========  =======================================================================

    Args:
        state_action_value: Q of each critic, ``(num_qvalue_nets, *B)``.
        rule: one of :data:`ACTING_RULES`.

    Returns:
        ``(*B,)``.

    Example:
        >>> q = torch.tensor([[1.0], [3.0]])
        >>> [ensemble_value(q, rule).item() for rule in ACTING_RULES]
        [1.0, 2.0, 1.0]
    """
    if rule == "mean":
        return state_action_value.mean(0)
    return state_action_value.amin(0) if rule == "min" else state_action_value[0]


def bcq_next_value(state_action_value: Tensor, lmbda: float | Tensor) -> Tensor:
    r"""BCQ's value of a next state: the soft clipped double-Q of the best candidate.

    .. math:: V(s') = \max_i [\lambda \min_j Q_j(s', a_i) + (1 - \lambda) \max_j Q_j(s', a_i)]

    Reference: BCQ, eq. 13; this project's paper, eqs. 1-2.

    Args:
        state_action_value: ``(num_qvalue_nets, *B, num_candidates)``.
        lmbda: λ in [0, 1].

    Returns:
        ``(*B,)``. The maximum comes after the mix over critics.

    Example:
        >>> q = torch.tensor([[[1.0, 2.0]], [[3.0, 2.5]]])  # two critics, one state, two candidates
        >>> bcq_next_value(q, 1.0)
        tensor([2.])
    """
    return soft_clipped_value(state_action_value, lmbda).amax(-1)


def likely_actions(logits: Tensor, threshold: float | Tensor) -> Tensor:
    r"""Mask of the actions that are likely enough, compared with the likeliest one.

    .. math:: \frac{G(a|s)}{\max_{a'} G(a'|s)} > \tau

    Reference: discrete BCQ.

    Args:
        logits: of the behaviour's classifier, ``(*B, num_actions)``.
        threshold: τ in [0, 1]. The likeliest action always passes.

    Returns:
        boolean, ``(*B, num_actions)``.

    Example:
        >>> likely_actions(torch.tensor([0.6, 0.3, 0.1]).log(), 0.3)
        tensor([ True,  True, False])
    """
    ratio = (logits - logits.amax(-1, keepdim=True)).exp()
    return (ratio > threshold) | (ratio == 1)


def squared_error(prediction: Tensor, target: Tensor) -> Tensor:
    r"""Squared Euclidean distance, :math:`\lVert \hat g - g \rVert_2^2`.

    Reference: meta-distillation.

    Args:
        prediction: ``(*B, n)``.
        target: ``(*B, n)``.

    Returns:
        ``(*B,)``.

    Example:
        >>> squared_error(torch.tensor([1.0, 2.0]), torch.zeros(2))
        tensor(5.)
    """
    return (prediction - target).square().sum(-1)


def triplet_error(anchor: Tensor, positive: Tensor, negative: Tensor, margin: float) -> Tensor:
    r"""Triplet loss: an embedding of the same task should be nearer than one of another task.

    .. math:: \max(0,\ \lVert m - m^+ \rVert - \lVert m - m^- \rVert + \alpha)

    Reference: Li et al., *Multi-task Batch Reinforcement Learning with Metric Learning*, NeurIPS
    2020, https://arxiv.org/abs/1909.11373.

    PyTorch's distance adds 1e-6 to every difference, so that equal points have a gradient.

    Args:
        anchor: m, ``(*B, n)``.
        positive: an embedding of the same task, ``(*B, n)``.
        negative: an embedding of another task, ``(*B, n)``.
        margin: α, in units of m.

    Returns:
        ``(*B,)``.

    Example:
        >>> a, near, far = torch.zeros(2), torch.tensor([1.0, 0.0]), torch.tensor([0.0, 3.0])
        >>> triplet_error(a, near, far, 1.0), triplet_error(a, far, near, 1.0)
        (tensor(0.), tensor(3.))
    """
    near, far = F.pairwise_distance(anchor, positive), F.pairwise_distance(anchor, negative)
    return (near - far + margin).clamp(min=0.0)


def isometry_error(task_latent: Tensor, content: Tensor, valid: Tensor | None = None) -> Tensor:
    r"""Mean squared difference between distances in an embedding and in its content.

    .. math:: \frac{1}{n} \sum_j \left(\lVert m_i - m_j \rVert - \lVert c_i - c_j \rVert\right)^2

    The stress of multi-dimensional scaling (Kruskal, *Multidimensional scaling by optimizing
    goodness of fit to a nonmetric hypothesis*, Psychometrika 1964), without its normalisation.

    Args:
        task_latent: m, ``(*B, n, d)``.
        content: c, ``(*B, n, k)``.
        valid: which rows count as j, ``(*B, n)``; ``None`` if all do.

    Returns:
        ``(*B, n)``; its gradients are finite also for equal points.

    Example:
        >>> content = torch.tensor([[0.0], [3.0]])
        >>> isometry_error(torch.tensor([[1.0, 1.0], [1.0, 4.0]]), content)
        tensor([0., 0.])
    """

    def distances(points: Tensor) -> Tensor:
        difference = points.unsqueeze(-2) - points.unsqueeze(-3)
        return (difference.square().sum(-1) + 1e-12).sqrt()

    error = (distances(task_latent) - distances(content)).square()
    if valid is None:
        return error.mean(-1)
    weight = valid.to(error.dtype).unsqueeze(-2)
    return (error * weight).sum(-1) / weight.sum(-1).clamp(min=1.0)


def direction_error(prediction: Tensor, target: Tensor) -> Tensor:
    r"""One minus the cosine of the angle between prediction and target.

    .. math:: 1 - \frac{\hat g \cdot g}{\lVert\hat g\rVert \lVert g\rVert}

    Reference: meta-distillation.

    Args:
        prediction: ``(*B, n)``.
        target: ``(*B, n)``.

    Returns:
        ``(*B,)`` in [0, 2].

    Example:
        >>> direction_error(torch.tensor([2.0, 0.0]), torch.tensor([0.0, 1.0]))
        tensor(1.)
    """
    return 1.0 - F.cosine_similarity(prediction, target, dim=-1)


def mean_and_scale(values: Tensor) -> tuple[Tensor, Tensor]:
    r"""Mean and standard deviation for normalising; finite for all finite numbers.

    .. math:: \mu = \frac{1}{N} \sum_i x_i, \qquad
              \sigma = \sqrt{\frac{1}{N} \sum_i (x_i - \mu)^2},
              \text{ or } 1 \text{ where all } x_i \text{ are equal up to rounding}

    (:func:`nonzero_scale`). The sums are float64, over differences from the first row, in two
    passes over chunks of the data, so that a small spread around a large number keeps its digits.

    Args:
        values: floating-point numbers, ``(N, n)``, finite, N of at least 1.

    Returns:
        mean and scale, float64, ``(n,)`` each.

    Example:
        >>> mean_and_scale(torch.tensor([[1.0, 0.1], [3.0, 0.1]]))
        (tensor([2.0000, 0.1000], dtype=torch.float64), tensor([1., 1.], dtype=torch.float64))
    """
    low, high = (extreme.double() for extreme in values.aminmax(dim=0))
    largest = torch.maximum(low.abs(), high.abs())
    unit = torch.where(largest > 1e150, largest, 1.0)  # the squares of larger numbers are infinite
    first = values[0].double() / unit
    parts = values.split(1 << 16)
    loc = sum((part.double() / unit - first).sum(0) for part in parts) / len(values)
    square = sum((part.double() / unit - first - loc).square().sum(0) for part in parts)
    scale = (square / len(values)).sqrt() * unit
    return (first + loc) * unit, nonzero_scale(scale, largest, values.dtype)


def nonzero_scale(scale: Tensor, largest: Tensor, dtype: torch.dtype) -> Tensor:
    """Standard deviations to divide by, with 1 in place of those that are only rounding errors.

    A standard deviation counts as rounding error up to two units in the last place of the largest
    number, and up to 1e-7 (float64: 1e-12) in any case: results computed from numbers around 1 have
    errors of this size, even if they are small themselves.

    Args:
        scale: standard deviations, ``(*B)``.
        largest: largest magnitude of the numbers, ``(*B)``.
        dtype: of the numbers.

    Example:
        >>> nonzero_scale(torch.tensor([0.0, 1e-17, 0.5]), torch.ones(3), torch.float64)
        tensor([1.0000, 1.0000, 0.5000])
    """
    rounding = 2 * torch.finfo(dtype).eps * largest
    noise = rounding.clamp_min(1e-12 if dtype == torch.float64 else 1e-7)
    return torch.where(scale > noise, scale, 1.0)


def unpadded(value: Tensor, valid: Tensor | None) -> Tensor:
    """The numbers of each row, with 0 in the rows that a mask leaves out.

    Args:
        value: ``(..., *B)``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Example:
        >>> unpadded(torch.tensor([1.0, torch.nan]), torch.tensor([True, False]))
        tensor([1., 0.])
    """
    return value if valid is None else torch.where(valid, value, torch.zeros_like(value))


def average(value: Tensor, valid: Tensor | None) -> Tensor:
    """Mean of a metric over the rows that count, detached.

    Args:
        value: ``(..., *B)``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.

    Example:
        >>> average(torch.tensor([1.0, 7.0]), torch.tensor([True, False]))
        tensor(1.)
    """
    value = value.detach()
    if valid is None:
        return value.mean()
    number = valid.sum().clamp(min=1) * (value.numel() // valid.numel())
    return unpadded(value, valid).sum() / number
