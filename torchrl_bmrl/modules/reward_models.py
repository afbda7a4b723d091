"""Ensembles of models of the reward, one ensemble for each task."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_bmrl.modules.generator import sized
from torchrl_bmrl.modules.scales import set_scales


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
    """Predictions are relative to ``reward_loc`` and ``reward_scale``, steps to ``step_scale``."""

    step_scale: Tensor
    reward_loc: Tensor
    reward_scale: Tensor

    def __init__(
        self, num_tasks: int, num_models: int, sizes: Sequence[int], observation_dim: int
    ) -> None:
        super().__init__()
        layers = (_Layer(num_tasks, num_models, *pair) for pair in pairwise(sizes))
        self.layers = nn.ModuleList(layers)
        self.register_buffer("step_scale", torch.ones(observation_dim))
        self.register_buffer("reward_loc", torch.zeros(1))
        self.register_buffer("reward_scale", torch.ones(1))

    @torch.no_grad()
    def set_scales(self, *datasets: TensorDictBase) -> None:
        """Sets the buffers, so that rewards and steps are as large as the rest.

        Args:
            *datasets: transitions of all tasks and behaviours, ``[N_i]`` each.
        """
        set_scales(self, *datasets)

    def forward(self, observation: Tensor, action: Tensor, *following: Tensor) -> Tensor:
        steps = [(after - observation) / self.step_scale for after in following]
        # (num_tasks, 1, B, n), for every model
        features = torch.cat([observation, action, *steps], -1).unsqueeze(1)
        first, *rest = self.layers
        features = first(features)
        for layer in rest:
            features = layer(features.relu())
        return self.reward_loc + self.reward_scale * features.squeeze(-1).transpose(1, 2)


def make_reward_models(
    num_tasks: int,
    observation_dim: int,
    action_dim: int,
    *,
    num_models: int = 20,
    num_cells: Sequence[int] = (128,),
    reads_next: bool = False,
) -> TensorDictModule:
    """Models of each task's reward, all run as one batched program.

    Reads ``observation`` and ``action``, batch ``[num_tasks, B]``, of which row i is given to the
    models of task i, and writes their predictions, ``reward_prediction (num_tasks, B,
    num_models)``. The network's ``set_scales(*datasets)`` fits it to the size of rewards and steps.

    Reference: Li et al., *Multi-task Batch Reinforcement Learning with Metric Learning*, NeurIPS
    2020, https://arxiv.org/abs/1909.11373, section 4.2; the defaults are those of its code.

    Args:
        num_tasks: number of tasks.
        observation_dim: size of the observation.
        action_dim: size of the action.
        num_models: of each task.
        num_cells: widths of the hidden layers.
        reads_next: whether the models also read ``("next", "observation")``, for rewards of what
            happened in the step, such as a velocity.

    Example:
        >>> from tensordict import TensorDict
        >>> models = make_reward_models(4, 3, 2, num_models=5)
        >>> data = {"observation": torch.zeros(4, 8, 3), "action": torch.zeros(4, 8, 2)}
        >>> models(TensorDict(data, [4, 8]))["reward_prediction"].shape
        torch.Size([4, 8, 5])
    """
    reads: dict[NestedKey, int] = {"observation": observation_dim, "action": action_dim}
    if reads_next:
        reads["next", "observation"] = observation_dim
    sizes = (sum(reads.values()), *num_cells, 1)
    network = _RewardModels(num_tasks, num_models, sizes, observation_dim)
    module = sized(network, reads, {"reward_prediction": num_models})
    module.sizes = {}  # a run on rows of no task, as losses check sizes by, is impossible
    return module
