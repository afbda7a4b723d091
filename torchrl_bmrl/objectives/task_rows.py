"""Random rows of a batch ``[num_tasks, B]``: of the same task, and of other tasks."""

from __future__ import annotations

import torch
from torch import Tensor


def draw_partners(num_tasks: int, device: torch.device) -> Tensor:
    """For each task another one, ``(num_tasks,)``: all are shifted by the same random number.

    Args:
        num_tasks: at least two.
        device: of the result.
    """
    shift = torch.randint(1, num_tasks, (1,), device=device)
    return (torch.arange(num_tasks, device=device) + shift) % num_tasks


def draw_rows(task_latent: Tensor, valid: Tensor | None, number: int) -> Tensor:
    """For each row the m of some random rows of its task, ``(num_tasks, B, number, m)``.

    Args:
        task_latent: m, ``(num_tasks, B, m)``.
        valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.
        number: of rows to draw.
    """
    num_tasks, rows, size = task_latent.shape
    if valid is None:
        return task_latent[:, torch.randint(rows, (rows, number), device=task_latent.device)]
    # The valid rows come first. A task without any draws its first row, which counts nowhere.
    order = (~valid).to(torch.uint8).argsort(dim=-1, stable=True)
    count = valid.sum(-1, keepdim=True).clamp(min=1)
    share = torch.rand(num_tasks, rows * number, device=task_latent.device)
    index = order.gather(1, (share * count).long().clamp(max=rows - 1))
    chosen = task_latent.gather(1, index.unsqueeze(-1).expand(-1, -1, size))
    return chosen.view(num_tasks, rows, number, size)


def draw_others(task_latent: Tensor, valid: Tensor | None) -> tuple[Tensor, Tensor]:
    """For each row the m of another row of its task and of a row of another task.

    Those that count are drawn, as long as there is another one.

    Args:
        task_latent: m, ``(num_tasks, B, m)``.
        valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.

    Returns:
        two tensors ``(num_tasks, B, m)``.
    """
    num_tasks, rows = task_latent.shape[:2]
    device = task_latent.device
    # A cyclic shift by 1 to n - 1 never draws the row, or the task, itself.
    if valid is None:
        shift = torch.randint(1, max(rows, 2), (rows,), device=device)
        near = task_latent[:, (torch.arange(rows, device=device) + shift) % rows]
        far = task_latent
        shift = torch.randint(1, num_tasks, (num_tasks, rows), device=device)
        task = (torch.arange(num_tasks, device=device).unsqueeze(-1) + shift) % num_tasks
    else:
        far = draw_rows(task_latent, valid, 1).squeeze(2)
        index = _draw_another(valid)
        near = task_latent.gather(1, index.unsqueeze(-1).expand_as(task_latent))
        task = _draw_another(valid.any(1).expand(rows, -1)).T
    row = torch.randint(rows, (num_tasks, rows), device=device)
    return near, far[task, row]


def _draw_another(valid: Tensor) -> Tensor:
    """For each of the last axis another one that counts; itself if there is none, ``(B, n)``."""
    order = (~valid).to(torch.uint8).argsort(dim=-1, stable=True)  # those that count come first
    number = valid.sum(-1, keepdim=True).clamp(min=1)
    shift = 1 + (torch.rand(valid.shape, device=valid.device) * (number - 1)).long()
    return order.gather(1, (order.argsort(-1) + shift) % number)


def draw_pairs(points: Tensor, valid: Tensor | None) -> tuple[Tensor, Tensor]:
    """For each point another one of its task and one of every other task.

    Those that count are drawn, as long as there is another one.

    Args:
        points: ``(num_tasks, C, m)``.
        valid: which points count, ``(num_tasks, C)``; ``None`` if all do.

    Returns:
        ``(num_tasks, C, m)`` and ``(num_tasks, C, num_tasks - 1, m)``, the tasks after the point's
        own in turn.
    """
    num_tasks, count, _ = points.shape
    device = points.device
    others = other_tasks(num_tasks, device)
    if valid is not None:
        near = points.gather(1, _draw_another(valid).unsqueeze(-1).expand_as(points))
        drawn = draw_rows(points, valid, num_tasks - 1)
        turn = torch.arange(num_tasks - 1, device=device)
        return near, drawn[others, :, turn].transpose(1, 2)
    shift = torch.randint(1, max(count, 2), (count,), device=device)
    near = points[:, (torch.arange(count, device=device) + shift) % count]
    index = torch.randint(count, (num_tasks, count, num_tasks - 1), device=device)
    return near, points[others.unsqueeze(1), index]


def other_tasks(num_tasks: int, device: torch.device) -> Tensor:
    """For each task the numbers of those after it in turn, ``(num_tasks, num_tasks - 1)``."""
    task = torch.arange(num_tasks, device=device).unsqueeze(-1)
    return (task + torch.arange(1, num_tasks, device=device)) % num_tasks
