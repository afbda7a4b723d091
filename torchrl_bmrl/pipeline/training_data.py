"""The data that the critics of stage 1 learn from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.data import ActionChunks, NStep
from torchrl_bmrl.functional import nonzero_scale
from torchrl_bmrl.pipeline.settings import BCQSettings


def training_data(datasets: Sequence[TensorDictBase], bcq: BCQSettings) -> list[TensorDictBase]:
    """Returns the transitions of one task as stage 1 learns from them.

    Rewards are standardised (``bcq.standard_reward``), and rows get the outcome of ``n_steps``
    steps or a chunk of ``action_chunk`` actions. The given data do not change.

    Args:
        datasets: parts of the data ``[N]``, whole episodes in order of time; the first one decides
            the mean and the standard deviation of the rewards.
        bcq: the settings.

    Example:
        >>> from tensordict import TensorDict
        >>> done = torch.zeros(4, 1, dtype=torch.bool)
        >>> after = {"reward": torch.tensor([[1.0], [3.0], [1.0], [3.0]]), "done": done}
        >>> data = TensorDict({"next": after | {"terminated": done}}, [4])
        >>> (standard,) = training_data([data], BCQSettings(standard_reward=True))
        >>> standard["next", "reward"].flatten().tolist()
        [-0.866..., 0.866..., -0.866..., 0.866...]
    """
    data = list(datasets)
    if bcq.standard_reward:
        loc, scale = reward_statistics(data[0])
        data = [part.copy() for part in data]
        for part in data:
            reward = (part["next", "reward"] - loc) / scale
            part.set("next", part["next"].copy().set("reward", reward))
    if bcq.action_chunk > 1:
        return [ActionChunks(bcq.action_chunk, bcq.gamma)(part) for part in data]
    if bcq.n_steps > 1:
        return [NStep(bcq.n_steps, bcq.gamma)(part) for part in data]
    return data


def reward_statistics(data: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Returns mean and standard deviation of the rewards, ``()`` each.

    The mean is 0 if an episode terminates: to subtract a constant from every reward would make
    longer or shorter episodes worth more. An episode that is only cut off has no such end.

    Args:
        data: ``[N]`` with ``("next", "reward")`` and ``("next", "terminated")``.
    """
    reward = data["next", "reward"]
    loc = reward.new_zeros(()) if data["next", "terminated"].any() else reward.mean()
    return loc, deviation(reward)


def deviation(values: Tensor) -> Tensor:
    """Returns the standard deviation of numbers ``(N, 1)``; 1 if they are equal."""
    spread = values.std() if len(values) > 1 else torch.zeros_like(values).sum()
    return nonzero_scale(spread, values.abs().max(), values.dtype)
