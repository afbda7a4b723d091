"""Networks that a loss has copied: the originals stay untrained and must not be used."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from torch import nn

from torchrl_bmrl.errors import BMRLError

_COPIED: WeakKeyDictionary[nn.Module, str] = WeakKeyDictionary()


def note_copied(network: nn.Module, loss: str) -> None:
    """Records that a loss trains a copy of a network, and not the network or its parts.

    Args:
        network: the original.
        loss: name of the loss's class.

    Example:
        >>> note_copied(nn.Linear(1, 1), "BCQLoss")
    """
    for part in network.modules():
        if next(part.parameters(), None) is not None:  # an activation may be part of other networks
            _COPIED[part] = loss


def is_copied(network: nn.Module) -> bool:
    """Whether a loss trains a copy of this network, or a stack a copy of this loss.

    Args:
        network: the network or loss.

    Example:
        >>> is_copied(nn.Linear(1, 1))
        False
    """
    return network in _COPIED


def check_trained(name: str, network: Any) -> None:
    """Checks that a network is not the untrained original of a loss's copy.

    Args:
        name: of the argument, for the message.
        network: the network.

    Raises:
        BMRLError: naming what to use instead.

    Example:
        >>> critic = nn.Linear(1, 1)
        >>> check_trained("qvalue_network", critic)
        >>> note_copied(critic, "BCQLoss")
        >>> check_trained("qvalue_network", critic)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: qvalue_network was copied into a BCQLoss, which trains ...
    """
    parts = network.modules() if isinstance(network, nn.Module) else ()
    loss = next((_COPIED[part] for part in parts if part in _COPIED), None)
    if loss is not None:
        raise BMRLError(
            f"{name} was copied into a {loss}, which trains the copy: this one stays untrained; "
            "valid: the policy's live(loss), which follows the loss, or frozen(loss), a copy; "
            "extract_critic(loss) for the critic alone"
        )
