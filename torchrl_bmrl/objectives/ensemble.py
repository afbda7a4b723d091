"""Frozen networks, one for each task."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.utils import _vmap_func


class FrozenEnsemble(nn.Module):
    """Frozen modules, the i-th of which sees row i of the data.

    Their parameters are copies and buffers: no optimizer finds them, no gradient reaches them.
    Equally shaped modules run as one batched program, others one after the other.

    Args:
        modules: one per row.

    Example:
        >>> modules = [
        ...     TensorDictModule(nn.Linear(3, 2), in_keys=["x"], out_keys=["y"]) for _ in range(4)
        ... ]
        >>> ensemble = FrozenEnsemble(modules)
        >>> data = TensorDict({"x": torch.zeros(4, 5, 3)}, [4, 5])
        >>> ensemble(data)["y"].shape, ensemble.stacked, list(ensemble.parameters())
        (torch.Size([4, 5, 2]), True, [])
    """

    params: Any
    modules_: list[TensorDictModule]

    def __init__(self, modules: Sequence[TensorDictModule]) -> None:
        super().__init__()
        self.in_keys = list(dict.fromkeys(key for module in modules for key in module.in_keys))
        params = [TensorDict.from_module(module).data.clone() for module in modules]
        self.stacked = len({kind(module) for module in modules}) == 1
        if self.stacked:
            self.params = TensorDictParams(torch.stack(params), no_convert=True)
        else:
            self.params = nn.ModuleList(TensorDictParams(each, no_convert=True) for each in params)
        # Outside _modules: kept for their structure, their own parameters are no state of the loss.
        needed = modules[:1] if self.stacked else modules
        self.__dict__["modules_"] = [deepcopy(module).to("meta").eval() for module in needed]

    def forward(
        self, data: TensorDictBase, *, randomness: str = "error", loop: bool = False
    ) -> TensorDictBase:
        """Runs module i on row i.

        Args:
            data: batch ``[len(modules), B]``.
            randomness: of :func:`torch.vmap`.
            loop: one after the other also where they are equally shaped.
        """
        if self.stacked:
            run = _vmap_func(self.modules_[0], (0, 0), randomness=randomness, pseudo_vmap=loop)
            return run(data, self.params)
        rows = []
        for row, module, params in zip(data.unbind(0), self.modules_, self.params, strict=True):
            with params.to_module(module, preserve_module_state=False):
                rows.append(module(row.copy()))
        return torch.stack(rows)


def kind(module: nn.Module) -> str:
    """What tells modules apart beside their parameters: shapes, structure and plain attributes."""
    shapes = [tuple(value.shape) for value in module.state_dict().values()]
    attributes = [
        {name: _whole(value) for name, value in vars(part).items() if _tells(name, value)}
        for part in module.modules()
    ]
    return f"{module} {shapes} {attributes}"


_COMMON = frozenset(vars(TensorDictModule(nn.Identity(), in_keys=["x"], out_keys=["y"]))) - {
    "training",
    "in_keys",
    "out_keys",
}
"""Attributes that every module has, or a TensorDictModule; they hold no choice of a user's."""


def _tells(name: str, value: Any) -> bool:
    """Whether an attribute is a choice of a user's; of private ones only plain values are."""
    plain = isinstance(value, (int, float, str, torch.Tensor, type(None)))
    return name not in _COMMON and (plain or not name.startswith("_"))


def _whole(value: Any) -> Any:
    """A tensor with all of its numbers, which its text abbreviates."""
    return value.tolist() if isinstance(value, torch.Tensor) else value
