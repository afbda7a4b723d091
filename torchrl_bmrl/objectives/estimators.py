"""TorchRL's value estimators with exact hyper-parameters, and their inputs."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import (
    ValueEstimators,
    default_value_kwargs,
    dispatch_value_estimator,
)

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.checks import check_number
from torchrl_bmrl.objectives.data import entry, next_key


def make_estimator(
    loss: Any, value_type: Any, keys: dict[str, Any], hyperparams: dict[str, Any]
) -> float:
    """Makes a loss's value estimator, and returns its discount.

    TorchRL stores hyper-parameters in float32, where 0.99 is another number; here they have the
    dtype of the loss.

    Args:
        loss: the loss, with its networks and the discount ``gamma``.
        value_type: one of the loss's ``SUPPORTED_VALUE_ESTIMATORS``, or an estimator's class or
            instance.
        keys: of the estimator.
        hyperparams: of the estimator.

    Raises:
        BMRLError: for ``gamma`` outside [0, 1].
    """
    gamma = loss.gamma
    if not isinstance(value_type, ValueEstimators):
        LossModule.make_value_estimator(loss, value_type, **hyperparams)
        loss.value_estimator.set_keys(**keys)
        return float(getattr(loss.value_estimator, "gamma", gamma))
    estimator = dispatch_value_estimator(
        loss,
        value_type,
        supported=loss.SUPPORTED_VALUE_ESTIMATORS,
        tensor_keys=keys,
        value_network=None,
        **hyperparams,
    )
    reference = next(loss.parameters())
    estimator.to(dtype=reference.dtype, device=reference.device)
    exact = default_value_kwargs(loss.value_type) | {"gamma": gamma} | hyperparams
    gamma = check_number("gamma", exact["gamma"], 0, 1)
    for name, value in exact.items():
        if name in dict(estimator.named_buffers()):
            estimator.get_buffer(name).fill_(value)
    return gamma


def outcomes(tensordict: TensorDictBase, keys: Any, valid: Tensor | None, shape: Any) -> Any:
    """Reward and flags after the step, by key, checked; with a mask the return stops at padding.

    Args:
        tensordict: the data.
        keys: the loss's ``tensor_keys``.
        valid: which rows count, ``(*B,)``; ``None`` if all do.
        shape: of each, ``(*B, 1)``.

    Raises:
        BMRLError: for one that is missing, of another shape, or not finite, or a flag that is not
            boolean.
    """
    found: dict[NestedKey, Tensor] = {}
    for name in ("reward", "done", "terminated"):
        key = next_key(getattr(keys, name))
        found[key] = value = entry(tensordict, key, valid)
        if name != "reward" and value.dtype != torch.bool:
            raise BMRLError(f"{key!r} is {value.dtype}; valid: torch.bool")
        if value.shape != shape:
            raise BMRLError(
                f"{key!r} has the shape {tuple(value.shape)}; valid: {tuple(shape)}, the action's "
                "with a last dimension of one"
            )
        if valid is not None and name == "done":
            found[key] = value | _stops(tensordict, valid).unsqueeze(-1)
    return found


def _stops(tensordict: TensorDictBase, valid: Tensor) -> Tensor:
    """Rows where a return must stop: the last valid row before padding, and the padding."""
    # The estimators take the dimension named "time", or the last one, for time.
    names = tensordict.names if tensordict.ndim == valid.ndim else []
    time = names.index("time") if "time" in names else valid.ndim - 1
    ahead = valid.narrow(time, 1, valid.shape[time] - 1)
    last = valid.narrow(time, valid.shape[time] - 1, 1)
    return ~(valid & torch.cat([ahead, last], time))
