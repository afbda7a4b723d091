"""The entry that contains a set of transitions, and which networks read it."""

from __future__ import annotations

from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

CONTEXT = "context"
"""Key of the transitions of a context, batch ``[*B, K]``."""
MASK = (CONTEXT, "mask")
"""Key of which of them count, ``(*B, K)``."""


def reads_context(encoder: TensorDictModuleBase) -> bool:
    """Whether an encoder of m reads sets of transitions.

    Args:
        encoder: of m.

    Example:
        >>> from torchrl_bmrl.modules import make_context_encoder, make_task_encoder
        >>> reads_context(make_context_encoder(3, 2)), reads_context(make_task_encoder(3, 2))
        (True, False)
    """
    return any(isinstance(key, tuple) and key[0] == CONTEXT for key in encoder.in_keys)


def transition_keys(encoder: TensorDictModuleBase) -> list[NestedKey]:
    """Keys of one transition that an encoder of sets reads, now and under ``"next"``.

    Args:
        encoder: of m.

    Example:
        >>> from torchrl_bmrl.modules import make_context_encoder
        >>> transition_keys(make_context_encoder(3, 2))[:3]
        ['observation', 'action', ('next', 'reward')]
    """
    inside = (key for key in encoder.in_keys if isinstance(key, tuple) and key[0] == CONTEXT)
    return [unravel_key(key[1:]) for key in inside if key != MASK]
