"""Members of a stack of losses: how they are compared, and how their parameters are stacked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.ensemble import kind
from torchrl_bmrl.objectives.sizes import is_lazy


def state_of(loss: LossModule) -> dict[str, Any]:
    """Parameters and buffers of a loss by path: TensorDicts, and tensors outside them."""
    state: dict[str, Any] = {}
    for path, module in loss.named_modules():
        if isinstance(module, TensorDictParams):
            state[path] = module._param_td
        else:
            prefix = f"{path}." if path else ""
            buffers = module.named_buffers(recurse=False)
            state |= {f"{prefix}{name}": buffer for name, buffer in buffers}
    return state


def _leaves(value: Any) -> list[Tensor]:
    return [value] if isinstance(value, Tensor) else list(value.values(True, True))


def is_trained(value: Any) -> bool:
    """Whether a tensor, or one in a TensorDict, requires a gradient."""
    return any(leaf.requires_grad for leaf in _leaves(value))


def are_equal(values: Sequence[Any]) -> bool:
    """Whether tensors, or the TensorDicts of all members, hold equal numbers."""
    first, *others = map(_leaves, values)
    return all(all(map(torch.equal, first, other)) for other in others)


def stack_params(values: Sequence[TensorDictBase]) -> TensorDictParams:
    """Members' parameters and buffers stacked along a new first dimension."""
    stacked: Any = torch.stack([value.data for value in values]).contiguous()
    for key, leaf in values[0].items(True, True):
        if leaf.requires_grad:
            stacked.set(key, nn.Parameter(stacked.get(key)))
        elif isinstance(leaf, nn.Buffer):
            stacked.set(key, nn.Buffer(stacked.get(key)))
    return TensorDictParams(stacked, no_convert="skip")


def join(results: Sequence[Any]) -> Any:
    """Stacks what the members returned: tensors, in tuples and dicts."""
    first = results[0]
    if isinstance(first, Tensor):
        return torch.stack(list(results))
    if isinstance(first, dict):
        return {key: join([result[key] for result in results]) for key in first}
    if isinstance(first, tuple):
        return tuple(map(join, zip(*results, strict=True)))
    return first


def _kind(loss: LossModule) -> tuple[Any, ...]:
    """Everything in which the members of a stack must be equal."""
    return type(loss), kind(loss), loss.tensor_keys, loss.in_keys, loss.loss_mask_key


def check_members(losses: Sequence[LossModule], names: Sequence[str]) -> None:
    """Checks that losses can be stacked.

    Raises:
        BMRLError: for no losses, names that are not one for each, lazy networks, losses that
            differ, or networks that share parameters.
    """
    if not losses or len(names) != len(losses) or len(set(names)) < len(names):
        raise BMRLError(
            f"{len(losses)} losses named {list(names)}; valid: at least one, each with its own name"
        )
    if any(map(is_lazy, losses)):
        raise BMRLError("a loss has parameters without a shape; valid: losses that have run once")
    for name, loss in zip(names, losses, strict=True):
        if _kind(loss) != _kind(losses[0]):
            raise BMRLError(
                f"loss {name!r} differs from {names[0]!r} in kind, keys, networks or options; "
                "valid: equal ones, but for parameters and coefficients"
            )
    held = [leaf for loss in losses for part in state_of(loss).values() for leaf in _leaves(part)]
    trained = [id(leaf) for leaf in held if leaf.requires_grad]
    if len(set(trained)) < len(trained):
        raise BMRLError("networks of the losses share parameters; valid: each network has its own")
