"""Contexts for encoders of sets: groups of the rows of a batch ``[num_tasks, B]``."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_bmrl.errors import BMRLError

CONTEXT = "context"
"""Key of a context's transitions; the encoder of a set reads its entries under this key."""


def group_rows(
    data: TensorDictBase, size: int, valid: Tensor | None = None
) -> tuple[TensorDict, Tensor]:
    """Divides each task's rows into contexts at random, of 1 to ``size`` transitions each.

    A context leaves out a random share of its rows, so that an encoder learns from few transitions
    and from many.

    Args:
        data: the rows, ``[num_tasks, B]``.
        size: largest number of transitions of a context.
        valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.

    Returns:
        the contexts, ``[num_tasks, C]``, with ``[num_tasks, C, size]`` transitions and their
        ``mask`` under ``"context"``; and the number of each row's own context, ``(B,)``, C for a
        row that is in none.

    Raises:
        BMRLError: for fewer rows than two contexts need.
    """
    num_tasks, rows = data.batch_size
    count = rows // size
    if count < 2:
        raise BMRLError(
            f"the data have {rows} rows per task and context_size is {size}; valid: at least two "
            f"contexts, {2 * size} rows"
        )
    device = data.device or next(iter(data.values(True, True))).device
    order = torch.randperm(rows, device=device)[: count * size]
    own = torch.full((rows,), count, device=device)
    own[order] = torch.arange(count, device=device).repeat_interleave(size)
    grouped = data[:, order].reshape(num_tasks, count, size)
    share = torch.rand(num_tasks, count, 1, device=device)
    mask = torch.rand(num_tasks, count, size, device=device) < share
    mask[..., 0] = True
    if valid is not None:
        mask = mask & valid[:, order].reshape(mask.shape)
        mask = mask | ~mask.any(-1, keepdim=True)  # an empty one, whose rows count nowhere
    context = grouped.set("mask", mask)
    return TensorDict({CONTEXT: context}, batch_size=[num_tasks, count]), own


def assign(points: Tensor, own: Tensor, *, apart: bool) -> Tensor:
    """Gives every row the embedding of a random context of its task.

    Args:
        points: embeddings of the contexts, ``(num_tasks, C, m)``.
        own: number of each row's own context, ``(B,)``; C for none.
        apart: whether a row must not get the context that it is part of.

    Returns:
        ``(num_tasks, B, m)``.
    """
    count = points.shape[1]
    low = 1 if apart else 0
    shift = torch.randint(low, count, own.shape, device=own.device)
    return points[:, (own.clamp(max=count - 1) + shift) % count]
