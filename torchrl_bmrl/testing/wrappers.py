"""Wrappers of a loss's networks: with other keys, on a shared torso, or with dropout."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_bmrl.testing.case import CRITIC, Case


def renamed(key: Any, names: Mapping[Any, Any]) -> Any:
    """A key with its new name; the prefixes ``"next"``, ``"previous"`` and ``"context"`` are kept.

    Example:
        >>> renamed(("next", "reward"), {"reward": ("my", "reward")})
        ('next', 'my', 'reward')
    """
    if isinstance(key, tuple) and key[0] in ("next", "previous", "context"):
        rest = key[1] if len(key) == 2 else key[1:]
        return unravel_key((names.get(key[0], key[0]), renamed(rest, names)))
    return names.get(key, key)


class Renamed(TensorDictModuleBase):
    """A network that reads and writes under other names."""

    def __init__(self, network: TensorDictModuleBase, names: Mapping[Any, Any]) -> None:
        super().__init__()
        self.network = network
        self.in_keys = [renamed(key, names) for key in network.in_keys]
        self.out_keys = [renamed(key, names) for key in network.out_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Runs the network on the entries under its own names."""
        inner = TensorDict({}, batch_size=tensordict.batch_size)
        for own, key in zip(self.network.in_keys, self.in_keys, strict=True):
            inner.set(own, tensordict.get(key))
        self.network(inner)
        for own, key in zip(self.network.out_keys, self.out_keys, strict=True):
            tensordict.set(key, inner.get(own))
        return tensordict


class OnTorso(TensorDictModuleBase):
    """A network that reads a torso's features of the observation, scaled by its own parameter."""

    def __init__(self, network: TensorDictModuleBase, torso: nn.Linear, observation: Any) -> None:
        super().__init__()
        self.network, self.torso, self.observation = network, torso, observation
        self.gain = nn.Parameter(torch.rand(torso.out_features, dtype=torso.weight.dtype))
        self.in_keys, self.out_keys = list(network.in_keys), list(network.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Runs the network on the features."""
        inner = tensordict.select(*self.in_keys)
        inner.set(self.observation, self.gain * self.torso(inner.get(self.observation)))
        self.network(inner)
        for key in self.out_keys:
            tensordict.set(key, inner.get(key))
        return tensordict


class Dropped(TensorDictModuleBase):
    """A network with dropout after its output."""

    def __init__(self, network: TensorDictModuleBase) -> None:
        super().__init__()
        self.network, self.dropout = network, nn.Dropout(0.5)
        self.in_keys, self.out_keys = list(network.in_keys), list(network.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Runs the network, then the dropout."""
        tensordict = self.network(tensordict)
        key = self.out_keys[-1]
        return tensordict.set(key, self.dropout(tensordict.get(key)))


def with_dropout(name: str, network: TensorDictModuleBase) -> TensorDictModuleBase:
    """The edit that adds dropout to every critic."""
    return Dropped(network) if name.rstrip("s").endswith(CRITIC) else network


def on_torso(
    case: Case, *, sharing: str = "all", **options: Any
) -> tuple[Any, nn.Linear, dict[str, list[TensorDictModuleBase]]]:
    """A loss whose networks share a torso, the torso, and the networks by name.

    Args:
        case: the case that builds it.
        sharing: the networks that share it: ``"all"``, only the ``"critics"``, or ``"first"``: all
            except the critics after the first.
        **options: of the loss.
    """
    torch.manual_seed(7)
    observation, size = observation_of(case)
    torso = nn.Linear(size, size, dtype=torch.float64)
    networks: dict[str, list[TensorDictModuleBase]] = {}

    def edit(name: str, network: TensorDictModuleBase) -> TensorDictModuleBase:
        critic, first = name == CRITIC, name not in networks
        sharer = {"all": True, "critics": critic, "first": first or not critic}[sharing]
        if sharer and observation in network.in_keys:
            network = OnTorso(network, torso, observation)
        networks.setdefault(name, []).append(network)
        return network

    return case.make(edit=edit, **options), torso, networks


def observation_of(case: Case) -> tuple[Any, int]:
    """Key and size of the first entry that the critics read of a state."""
    data = case.batch()
    (critic,) = case.critics(1)
    for key in critic.in_keys:
        after = data.get(("next", key) if isinstance(key, str) else ("next", *key), None)
        if after is not None and key != "action":
            return key, after.shape[-1]
    raise AssertionError(f"the critics read {critic.in_keys}; the data's 'next' has none of these")
