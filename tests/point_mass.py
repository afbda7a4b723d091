"""A family of tasks: a point moves by its action, and the reward is its distance from a goal."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor


def point_mass(goals: np.ndarray, rows: int, seed: int = 0) -> TensorDict:
    """Random transitions of each goal, ``[num_goals, rows]``; only the reward shows the goal."""
    random = np.random.default_rng(seed)
    shape = (len(goals), rows)
    position = random.uniform(-1, 1, (*shape, 2))
    action = random.uniform(-1, 1, (*shape, 2))
    after = position + 0.5 * action
    reward = -np.linalg.norm(after - goals[:, None], axis=-1, keepdims=True)

    def tensor(value: np.ndarray) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float32)

    flag = torch.zeros(*shape, 1, dtype=torch.bool)
    outcome = {"observation": tensor(after), "reward": tensor(reward)}
    outcome |= {"done": flag, "terminated": flag}
    task = torch.arange(len(goals)).unsqueeze(-1).expand(shape)
    data = {"observation": tensor(position), "action": tensor(action), "task": task}
    return TensorDict(data | {"next": outcome}, shape)


def nearness(one: Tensor, other: Tensor) -> float:
    """Distance of a task's two embeddings, ``(num_tasks, m)``, as a share of those of others."""
    distance = torch.cdist(one, other)
    count = len(one)
    own, whole = distance.diagonal().sum(), distance.sum()
    return (own / count / ((whole - own) / (count * (count - 1)))).item()


def on_circle(angles: np.ndarray) -> np.ndarray:
    """Goals at distance 1, ``(*B, 2)``."""
    return np.stack([np.cos(angles), np.sin(angles)], -1)


GOALS = on_circle(np.arange(8) * np.pi / 4)
HELD_OUT = on_circle(np.array([0.5, 2.5, 4.5, 6.5]) * np.pi / 4)
