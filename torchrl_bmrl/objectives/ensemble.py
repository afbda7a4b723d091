"""Several networks as one: an ensemble of critics, and frozen networks, one for each task."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.objectives.utils import _vmap_func

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.sizes import is_lazy


class Ensemble(TensorDictModuleBase):
    """Critics that run one after the other; their outputs are stacked along a new dimension.

    Args:
        critics: at least one, which may differ in structure and share parameters.
    """

    def __init__(self, critics: Sequence[TensorDictModule]) -> None:
        super().__init__()
        self.critics = nn.ModuleList(critics)
        self.in_keys = list(dict.fromkeys(key for critic in critics for key in critic.in_keys))
        self.out_keys = critics[0].out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Outputs of all critics, batch ``[n, *B]``."""
        return torch.stack([critic(tensordict.copy()) for critic in self.critics])


def can_stack(critics: Sequence[TensorDictModule], others: Iterable[nn.Parameter]) -> bool:
    """Whether the parameters of critics can be stacked into one set, as TorchRL does.

    Stacking makes new parameters of one structure. So critics that differ, share parameters (with
    each other, with another network or within themselves) or are lazy cannot be stacked; and from
    a list with one critic TorchRL would make no parameters at all.

    Args:
        critics: the critics.
        others: parameters of the other networks.
    """
    owners = [id(p) for critic in critics for p in critic.parameters()]
    places = [x for critic in critics for x in critic.named_parameters(remove_duplicate=False)]
    return (
        len(critics) > 1
        and not any(map(is_lazy, critics))
        and len({kind(critic) for critic in critics}) == 1
        and len(set(owners)) == len(places)
        and {id(p) for p in others}.isdisjoint(owners)
    )


def copies(
    critic: TensorDictModule, number: int, shared: Sequence[nn.Parameter]
) -> list[TensorDictModule]:
    """A critic and copies of it, each initialised anew except for shared parameters.

    Args:
        critic: the first of them.
        number: of critics in all.
        shared: parameters of other networks, which the copies share, too.

    Raises:
        BMRLError: for a layer with parameters that has no ``reset_parameters``.
    """
    memo = {id(parameter): parameter for parameter in shared}
    critics = [critic, *(deepcopy(critic, dict(memo)) for _ in range(number - 1))]
    for name, part in (x for copy in critics[1:] for x in copy.named_modules()):
        own = [p for p in part.parameters(recurse=False) if p.requires_grad and id(p) not in memo]
        if own and not hasattr(part, "reset_parameters"):
            raise BMRLError(
                f"the critic's part {name!r}, a {type(part).__name__}, has no reset_parameters() "
                "to initialise a copy with; valid: a list of critics, each initialised on its own"
            )
        if own:
            part.reset_parameters()
    return critics


class FrozenEnsemble(nn.Module):
    """Frozen modules, of which the i-th reads row i of the data.

    Their parameters are copied into buffers, so no optimizer finds them and no gradient reaches
    them. Modules of equal shapes run as one batched program, others one after the other.

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
        # Outside _modules: only their structure is used, so their parameters are no state.
        needed = modules[:1] if self.stacked else modules
        self.__dict__["modules_"] = [deepcopy(module).to("meta").eval() for module in needed]

    def forward(
        self, data: TensorDictBase, *, randomness: str = "error", loop: bool = False
    ) -> TensorDictBase:
        """Runs module i on row i.

        Args:
            data: batch ``[len(modules), B]``.
            randomness: of :func:`torch.vmap`.
            loop: whether to run modules of equal shapes one after the other, too.
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
    """What defines a module besides its parameters: structure, shapes, plain attributes."""
    shapes = [tuple(value.shape) for value in module.state_dict().values()]
    attributes = [
        {name: _whole(value) for name, value in vars(part).items() if _is_choice(name, value)}
        for part in module.modules()
    ]
    return f"{module} {shapes} {attributes}"


_COMMON = frozenset(vars(TensorDictModule(nn.Identity(), in_keys=["x"], out_keys=["y"]))) - {
    "training",
    "in_keys",
    "out_keys",
}
"""Attributes that every module or TensorDictModule has; no user chooses them."""


def _is_choice(name: str, value: Any) -> bool:
    """Whether a user may have chosen an attribute; of private ones only plain values count."""
    plain = isinstance(value, (int, float, str, torch.Tensor, type(None)))
    return name not in _COMMON and (plain or not name.startswith("_"))


def _whole(value: Any) -> Any:
    """A tensor as a list of all its numbers, which its text abbreviates."""
    return value.tolist() if isinstance(value, torch.Tensor) else value
