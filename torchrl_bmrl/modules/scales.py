"""How large steps and rewards are, for networks that read them beside normalised observations."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

MARK = 1e-2
"""A number marks a task if its variance at the start is a smaller share of that between tasks."""
SAME = 1e-4
"""Variance between tasks below which their starts count as equal, of normalised observations."""


def set_scales(network: Any, *datasets: TensorDictBase) -> None:
    """Sets a network's ``step_scale (obs_dim,)``, ``reward_loc (1,)`` and ``reward_scale (1,)``.

    They are the standard deviation of each number's change in a step, and the mean and the standard
    deviation of the rewards. A deviation of next to nothing becomes 1.

    Args:
        network: with these buffers.
        *datasets: transitions, ``[N_i]`` each.
    """
    steps = torch.cat([x["next", "observation"] - x["observation"] for x in datasets]).double()
    reward = torch.cat([x["next", "reward"] for x in datasets]).double()
    several = int(len(steps) > 1)  # one transition has no deviation
    # A number that hardly moves carries rounding errors, which must not be enlarged.
    deviation = steps.std(0, correction=several)
    network.step_scale.copy_(torch.where(deviation > 1e-3, deviation, 1.0))
    network.reward_loc.copy_(reward.mean(0))
    deviation = reward.std(0, correction=several)
    network.reward_scale.copy_(torch.where(deviation > 0, deviation, 1.0))


def unmarked(*datasets: TensorDictBase) -> Tensor:
    """Which numbers of the observation may be read, 1, and which are marks of a task, 0.

    A mark has one value at the start of all episodes of a task and another one in another task,
    such as the place of an object. Without ``step`` in the data, no mark is found.

    Args:
        *datasets: transitions of each task or behaviour, ``[N_i]`` each.

    Returns:
        ``(obs_dim,)``.
    """
    read = torch.ones(datasets[0]["observation"].shape[-1])
    if all("step" in data for data in datasets):
        starts = [data["observation"][data["step"] == 0].double() for data in datasets]
        within = torch.stack([start.var(0, correction=0) for start in starts]).mean(0)
        between = torch.stack([start.mean(0) for start in starts]).var(0, correction=0)
        read[(within < MARK * between) & (between > SAME)] = 0.0
    return read
