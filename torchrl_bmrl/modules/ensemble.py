"""An ensemble of critics as one critic."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn

from torchrl_bmrl.functional import ensemble_value


class EnsembleCritic(TensorDictModuleBase):
    """Critics that value an action together, by their mean or their minimum.

    A policy of a :class:`~torchrl_bmrl.objectives.BCQLoss` with ``acting_rule="mean"`` or ``"min"``
    acts with it.

    Args:
        critics: networks with equal keys, such as :func:`make_qvalue_network` returns.
        rule: of :func:`torchrl_bmrl.functional.ensemble_value`.
        key: of the value, one of ``out_keys``; ``None`` for the first of them.

    Reads what the critics read, batch ``[*B]``, and writes their value, ``(*B, 1)``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import make_qvalue_network
        >>> critic = EnsembleCritic([make_qvalue_network(3, 2) for _ in range(4)], "mean")
        >>> data = TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2)}, [5])
        >>> critic(data)["state_action_value"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self, critics: Sequence[TensorDictModule], rule: str, key: NestedKey | None = None
    ) -> None:
        super().__init__()
        self.critics = nn.ModuleList(critics)
        self.rule = rule
        self.in_keys = list(critics[0].in_keys)
        self.out_keys = [critics[0].out_keys[0] if key is None else key]
        self.sizes = dict(getattr(critics[0], "sizes", {}))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the value."""
        key, inputs = self.out_keys[0], tensordict.select(*self.in_keys)
        values = [critic(inputs.copy()).get(key) for critic in self.critics]
        return tensordict.set(key, ensemble_value(torch.stack(values), self.rule))
