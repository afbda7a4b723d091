"""Errors that arrange the embeddings of tasks: near for one task, apart for different tasks."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def distance_error(
    anchor: Tensor, positive: Tensor, negative: Tensor, *, power: float = 2.0, epsilon: float = 0.1
) -> Tensor:
    r"""FOCAL's distance metric loss: pulls embeddings of a task together, pushes tasks apart.

    .. math:: \lVert m - m^+ \rVert^2 + \frac{1}{\lVert m - m^- \rVert^n + \epsilon}

    Reference: Li et al., *FOCAL: Efficient Fully-Offline Meta-Reinforcement Learning via Distance
    Metric Learning and Behavior Regularization*, ICLR 2021, https://arxiv.org/abs/2010.01112,
    eq. 13, with β = 1.

    Args:
        anchor: m, ``(*B, d)``.
        positive: an embedding of the same task, ``(*B, d)``.
        negative: an embedding of another task, ``(*B, d)``.
        power: n.
        epsilon: ε, which bounds the second term.

    Returns:
        ``(*B,)``.

    Example:
        >>> a, far = torch.zeros(2), torch.tensor([0.0, 3.0])
        >>> distance_error(a, a, far, epsilon=1.0)
        tensor(0.1000)
    """
    near, apart = (anchor - positive).square().sum(-1), (anchor - negative).square().sum(-1)
    # The root of 0 has no gradient; a power of the square does from n = 2 on.
    return near + 1 / (apart.clamp(min=1e-12) ** (power / 2) + epsilon)


def contrastive_error(
    anchor: Tensor, positive: Tensor, temperature: float, compared: Tensor | None = None
) -> Tensor:
    r"""InfoNCE: how surely the other embedding of each task is recognised among those of all tasks.

    .. math:: -\log \frac{\exp(\cos(m_i, m_i^+) / \tau)}{\sum_j \exp(\cos(m_i, m_j^+) / \tau)}

    Reference: van den Oord et al., *Representation Learning with Contrastive Predictive Coding*,
    https://arxiv.org/abs/1807.03748; for tasks Yuan and Lu, *Robust Task Representations for
    Offline Meta-Reinforcement Learning via Contrastive Learning* (CORRO), ICML 2022,
    https://arxiv.org/abs/2206.10442.

    Args:
        anchor: m, ``(num_tasks, B, d)``.
        positive: another embedding of the row's task, likewise.
        temperature: τ.
        compared: which tasks the others are recognised among, ``(num_tasks,)``; ``None`` if all.

    Returns:
        ``(num_tasks, B)``.

    Example:
        >>> points = torch.eye(3).unsqueeze(1)  # one embedding for each of three tasks
        >>> contrastive_error(points, points, 0.1).max() < 1e-3
        tensor(True)
    """
    anchor, positive = F.normalize(anchor, dim=-1), F.normalize(positive, dim=-1)
    logits = torch.einsum("ibd,jbd->ibj", anchor, positive) / temperature
    own = logits.diagonal(dim1=0, dim2=2).transpose(0, 1)
    if compared is not None:  # a task's own embedding stays, so that the error is finite
        itself = torch.eye(len(logits), dtype=torch.bool, device=logits.device)
        logits = logits.masked_fill(~(compared | itself).unsqueeze(1), -torch.inf)
    return logits.logsumexp(-1) - own
