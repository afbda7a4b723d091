"""What losses with an encoder of contexts have in common."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.context_keys import MASK, transition_keys
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import written


def context_keys(encoder: TensorDictModule) -> list[NestedKey]:
    """Keys of a transition that an encoder of contexts reads, now and under ``"next"``.

    Raises:
        BMRLError: for an encoder of single transitions.
    """
    if MASK not in encoder.in_keys:
        raise BMRLError(
            f"task_encoder reads {list(encoder.in_keys)}; valid: an encoder of sets, such as "
            "torchrl_bmrl.modules.make_context_encoder"
        )
    return transition_keys(encoder)


def encode_contexts(
    loss: Any, contexts: TensorDictBase, rows: TensorDictBase, under: NestedKey = ()
) -> Tensor:
    """m of contexts, ``(num_tasks, C, m)``.

    Args:
        loss: with a ``task_encoder``.
        contexts: of :func:`.group_rows`.
        rows: that they are made of, for the message.
        under: a key of the data that contains the rows.

    Raises:
        BMRLError: with the shapes of the rows, if the encoder cannot read them.
    """
    try:
        points = loss.call("task_encoder", contexts)
    except BMRLError as error:
        shapes = _shapes(rows, transition_keys(loss.task_encoder), under)
        raise BMRLError(
            f"task_encoder cannot read contexts of {shapes}; valid: the sizes that it was made for "
            f"({error})"
        ) from error
    return written(points, loss.tensor_keys.task_latent, loss.task_encoder)


def _shapes(rows: TensorDictBase, keys: Iterable[NestedKey], under: NestedKey) -> str:
    named = ((unravel_key((under, key)), rows.get(key).shape) for key in keys)
    return ", ".join(f"{key!r} {tuple(shape)}" for key, shape in named)
