"""How large steps and rewards are, for networks that read them beside normalised observations."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase


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
