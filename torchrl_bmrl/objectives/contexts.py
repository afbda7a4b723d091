"""Contexts for encoders of sets: groups of the rows of a batch ``[num_tasks, B]``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_bmrl.context_keys import CONTEXT
from torchrl_bmrl.errors import BMRLError


class Embedded(NamedTuple):
    """m of a batch."""

    latent: Tensor  # of each row, (num_tasks, B, m)
    points: Tensor  # that the arranging terms compare: of the rows, or of the sets, likewise
    valid: Tensor | None  # which of the points count
    alone: Tensor | None = None  # of each row's own transition; None for sets


def group_rows(
    data: TensorDictBase, size: int, valid: Tensor | None = None
) -> tuple[TensorDict, Tensor, Tensor | None]:
    """Divides each task's rows into contexts at random, of 1 to ``size`` transitions each.

    A context leaves out a random share of its rows, so that an encoder learns from few transitions
    and from many. The rows that count are spread over the contexts evenly.

    Args:
        data: the rows, ``[num_tasks, B]``.
        size: largest number of transitions of a context.
        valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.

    Returns:
        the contexts, ``[num_tasks, C]``, with ``[num_tasks, C, size]`` transitions and their
        ``mask`` under ``"context"``; the number of each row's own context, ``(num_tasks, B)``, C
        for a row that is in none; and how many contexts of each task have a row that counts,
        ``(num_tasks,)``, which are its first ones, ``None`` for all.

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
    if valid is None:
        order = torch.randperm(rows, device=device)[: count * size].expand(num_tasks, -1)
    else:
        # Those that count come first, and each context gets one of them in turn.
        drawn = torch.rand(num_tasks, rows, device=device)
        order = (drawn + (~valid).to(drawn.dtype)).argsort(-1)[:, : count * size]
        order = order.reshape(num_tasks, size, count).transpose(1, 2).flatten(1)
    number = torch.arange(count, device=device).repeat_interleave(size)
    own = torch.full((num_tasks, rows), count, device=device)
    own = own.scatter(1, order, number.expand(num_tasks, -1))
    task = torch.arange(num_tasks, device=device).unsqueeze(-1)
    grouped = data[task, order].reshape(num_tasks, count, size)
    share = torch.rand(num_tasks, count, 1, device=device)
    mask = torch.rand(num_tasks, count, size, device=device) < share
    mask[..., 0] = True
    filled = None
    if valid is not None:
        mask = mask & valid.gather(1, order).reshape(mask.shape)
        filled = mask[..., 0].sum(-1)
        mask[..., 0] = True  # an empty context, which no row gets, must not be pooled
    context = grouped.set("mask", mask)
    return TensorDict({CONTEXT: context}, batch_size=[num_tasks, count]), own, filled


def assign(points: Tensor, own: Tensor, filled: Tensor | None, *, apart: bool) -> Tensor:
    """Gives every row the embedding of a random context of its task.

    Args:
        points: embeddings of the contexts, ``(num_tasks, C, m)``.
        own: number of each row's own context, ``(num_tasks, B)``; C for none.
        filled: how many contexts of each task have rows that count, ``(num_tasks,)``; ``None`` for
            all.
        apart: whether a row must not get the context that it is part of. It does if its task has
            no other one.

    Returns:
        ``(num_tasks, B, m)``.
    """
    num_tasks, count, size = points.shape
    low = 1 if apart else 0
    if filled is None:
        shift = torch.randint(low, count, own.shape[1:], device=own.device)
        chosen = (own.clamp(max=count - 1) + shift) % count
    else:
        number = filled.clamp(min=1).unsqueeze(-1)
        drawn = torch.rand(own.shape, device=own.device)
        shift = low + (drawn * (number - low)).long().clamp(max=count - 1)
        chosen = (torch.minimum(own, number - 1) + shift) % number
    return points.gather(1, chosen.unsqueeze(-1).expand(num_tasks, -1, size))


def which_count(count: int, filled: Tensor | None) -> Tensor | None:
    """Which contexts have a row that counts, ``(num_tasks, count)``; ``None`` if all do.

    Args:
        count: number of contexts of each task.
        filled: as of :func:`group_rows`.
    """
    if filled is None:
        return None
    return torch.arange(count, device=filled.device) < filled.unsqueeze(-1)
