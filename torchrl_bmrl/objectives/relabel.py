"""Transitions of other tasks with the reward that the own task would give."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import average, unpadded
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.base import KeyedLoss
from torchrl_bmrl.objectives.checks import check_network
from torchrl_bmrl.objectives.data import check_same_shape, entry, next_key, select


class RewardModelLoss(KeyedLoss):
    r"""Fits ensembles of reward models, one ensemble for each task, to the tasks' own rewards.

    .. math:: \frac{1}{E} \sum_e \left(\hat R_{i,e}(s, a) - r\right)^2

    Reference: Li et al., *Multi-task Batch Reinforcement Learning with Metric Learning*, NeurIPS
    2020, https://arxiv.org/abs/1909.11373, section 4.2. There all models of a task see the same
    batches, and differ by their initialisation: 4,000 updates of 128 rows, with Adam and a learning
    rate of 3e-4. The published loss is the sum over models, which is the same to Adam.

    Args:
        reward_models: :func:`torchrl_bmrl.modules.make_reward_models`'s module.

    Keyword Args:
        **options: of :class:`~torchrl_bmrl.objectives.KeyedLoss`.

    Keys read, batch ``[num_tasks, B]``: those of the models, and ``("next", "reward")``. Key
    written to the input: ``td_error (num_tasks, B)``, the priority: a row's error.

    Raises:
        BMRLError: at a call for data that do not fit.

    Example:
        >>> import torch
        >>> from torchrl_bmrl.modules import extract_network, make_reward_models
        >>> loss = RewardModelLoss(make_reward_models(4, 3, 2))
        >>> data = {"observation": torch.randn(4, 8, 3), "action": torch.randn(4, 8, 2)}
        >>> data |= {"next": {"reward": torch.randn(4, 8, 1)}}
        >>> loss(TensorDict(data, [4, 8]))["loss_reward"].backward()
        >>> models = extract_network(loss, "reward_models")  # for MBMLLoss
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename."""

        action: NestedKey = "action"
        reward: NestedKey = "reward"  # under "next"
        reward_prediction: NestedKey = "reward_prediction"  # the models' output
        priority: NestedKey = "td_error"  # written to the input
        priority_weight: NestedKey = "priority_weight"  # read from the input where present

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    reward_models: TensorDictModule
    reward_models_params: TensorDictParams
    target_reward_models_params: TensorDictParams

    def __init__(self, reward_models: TensorDictModule, **options: Any) -> None:
        super().__init__(**options)
        check_network("reward_models", reward_models)
        self.convert_to_functional(reward_models, "reward_models", create_target_params=False)
        self.keep_keys()

    def read_keys(self) -> list[NestedKey]:
        """What the models read, and the reward."""
        return [*self.reward_models.in_keys, next_key(self.tensor_keys.reward)]

    def written_keys(self) -> list[str]:
        """The loss, then the mean standard deviation of a row's predictions."""
        return ["loss_reward", "deviation"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss.

        Raises:
            BMRLError: for data that do not fit.
        """
        self.check_names()
        batch = tensordict.batch_size
        if len(batch) != 2:
            raise BMRLError(f"the data's batch size is {list(batch)}; valid: [num_tasks, B]")
        valid = self.valid_rows(tensordict, batch)
        predicted = predict(self, tensordict, valid)
        reward = read_reward(self, tensordict, valid)
        error = (predicted - reward).square().mean(-1)
        tensordict.set(self.tensor_keys.priority, unpadded(error.detach(), valid))
        deviation = average(predicted.std(-1), valid)
        return TensorDict({"loss_reward": self.reduce(error, tensordict), "deviation": deviation})


def read_reward(loss: Any, tensordict: TensorDictBase, valid: Tensor | None) -> Tensor:
    """The reward, ``(num_tasks, B, 1)``.

    Raises:
        BMRLError: for another shape, or numbers that are not finite.
    """
    key = next_key(loss.tensor_keys.reward)
    reward = entry(tensordict, key, valid)
    check_same_shape(key, reward, reward.new_empty(*tensordict.batch_size, 1))
    return reward


def predict(loss: Any, tensordict: TensorDictBase, valid: Tensor | None) -> Tensor:
    """Rewards that the models of each row's task predict, ``(num_tasks, B, num_models)``.

    Args:
        loss: with ``reward_models``.
        tensordict: the data, ``[num_tasks, B]``.
        valid: which rows count; ``None`` if all do.

    Raises:
        BMRLError: for data that do not fit.
    """
    keys = loss.reward_models.in_keys
    rows = select(tensordict, keys, tensordict.batch_size, valid, readers=loss.readers)
    output = loss.call("reward_models", rows.copy())
    return written(output, loss.tensor_keys.reward_prediction, loss.reward_models)
