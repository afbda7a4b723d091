"""Ensembles of models of the reward, one ensemble for each task."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.modules.generator import sized


class _Layer(nn.Module):
    """Linear layers of all models of all tasks."""

    def __init__(self, num_tasks: int, num_models: int, in_features: int, out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num_tasks, num_models, in_features, out))
        self.bias = nn.Parameter(torch.empty(num_tasks, num_models, 1, out))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        bound = self.weight.shape[-2] ** -0.5  # as in nn.Linear
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, features: Tensor) -> Tensor:
        return features @ self.weight + self.bias


class _RewardModels(nn.Module):
    def __init__(self, num_tasks: int, num_models: int, sizes: Sequence[int]) -> None:
        super().__init__()
        layers = (_Layer(num_tasks, num_models, *pair) for pair in pairwise(sizes))
        self.layers = nn.ModuleList(layers)

    def forward(self, *inputs: Tensor) -> Tensor:
        features = torch.cat(inputs, -1).unsqueeze(1)  # (num_tasks, 1, B, n), for every model
        first, *rest = self.layers
        features = first(features)
        for layer in rest:
            features = layer(features.relu())
        return features.squeeze(-1).transpose(1, 2)


def make_reward_models(
    num_tasks: int,
    observation_dim: int,
    action_dim: int,
    *,
    num_models: int = 20,
    num_cells: Sequence[int] = (128,),
) -> TensorDictModule:
    """Models of each task's reward, all run as one batched program.

    Reads ``observation`` and ``action``, batch ``[num_tasks, B]``, of which row i is given to the
    models of task i, and writes their predictions, ``reward_prediction (num_tasks, B,
    num_models)``.

    Reference: Li et al., *Multi-task Batch Reinforcement Learning with Metric Learning*, NeurIPS
    2020, https://arxiv.org/abs/1909.11373, section 4.2; the defaults are those of its code.

    Args:
        num_tasks: number of tasks.
        observation_dim: size of the observation.
        action_dim: size of the action.
        num_models: of each task.
        num_cells: widths of the hidden layers.

    Example:
        >>> from tensordict import TensorDict
        >>> models = make_reward_models(4, 3, 2, num_models=5)
        >>> data = {"observation": torch.zeros(4, 8, 3), "action": torch.zeros(4, 8, 2)}
        >>> models(TensorDict(data, [4, 8]))["reward_prediction"].shape
        torch.Size([4, 8, 5])
    """
    sizes = (observation_dim + action_dim, *num_cells, 1)
    reads = {"observation": observation_dim, "action": action_dim}
    network = _RewardModels(num_tasks, num_models, sizes)
    module = sized(network, reads, {"reward_prediction": num_models})
    module.sizes = {}  # a run on rows of no task, as losses check sizes by, is impossible
    return module
