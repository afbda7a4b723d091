"""Checkpoints: one safetensors file each, written whole or not at all, read without pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.files import write_atomic

_HEADER = "checkpoint"
_TENSOR, _PAIRS = "__tensor__", "__pairs__"


def save_checkpoint(path: Path, state: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Saves nested state dicts and what is needed to build what they belong to.

    Args:
        path: the file.
        state: nested dicts and lists of tensors and plain values, such as ``state_dict()`` of
            modules and optimizers.
        metadata: JSON-compatible description, read back by :func:`load_checkpoint`.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> save_checkpoint(path, {"step": 3, "weights": torch.ones(2)}, {"kind": "example"})
        >>> load_checkpoint(path, kind="example")[0]
        {'step': 3, 'weights': tensor([1., 1.])}
    """
    tensors: dict[str, Tensor] = {}
    header = {"state": _encode(state, "", tensors), "metadata": dict(metadata)}
    # One entry: safetensors orders several at random, and equal runs would differ in bytes.
    write_atomic(path, safetensors.torch.save(tensors, {_HEADER: json.dumps(header)}))


def load_checkpoint(path: Path, *, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads what :func:`save_checkpoint` wrote.

    Args:
        path: the file.
        kind: expected ``metadata["kind"]``.

    Returns:
        state and metadata.

    Raises:
        CheckpointError: if the file is missing, damaged, a pickle, or of another kind.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(path, "no such checkpoint")
    try:
        with safetensors.safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {})[_HEADER])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        metadata = header["metadata"]
        state = _decode(header["state"], tensors)
    except (safetensors.SafetensorError, KeyError, ValueError, OSError) as error:
        raise CheckpointError(
            path, f"not a whole checkpoint of this library in safetensors format ({error})"
        ) from error
    if metadata.get("kind") != kind:
        raise CheckpointError(path, f"kind is {metadata.get('kind')!r}; valid: {kind!r}")
    return state, metadata


def load_state(module: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Loads a module's state and names the first key or shape that does not fit.

    Raises:
        CheckpointError: if keys or shapes differ.
    """
    own = module.state_dict()
    for key in [*own, *state]:
        if key not in state or key not in own:
            where = "checkpoint" if key not in state else "networks"
            raise CheckpointError(path, f"key {key!r} is missing in the {where}")
        if isinstance(own[key], Tensor) and own[key].shape != state[key].shape:
            raise CheckpointError(
                path,
                f"{key!r} has shape {tuple(state[key].shape)}; "
                f"valid for these networks: {tuple(own[key].shape)}",
            )
    module.load_state_dict(dict(state))


def _encode(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, Tensor):
        tensors[name] = value.detach().cpu().clone().contiguous()
        return {_TENSOR: name}
    if isinstance(value, Mapping):
        pairs = [[key, _encode(item, f"{name}/{key}", tensors)] for key, item in value.items()]
        if all(isinstance(key, str) for key, _ in pairs):
            return dict(pairs)
        return {_PAIRS: pairs}  # JSON would turn an optimizer's integer keys into strings
    if isinstance(value, (list, tuple)):
        return [_encode(item, f"{name}/{i}", tensors) for i, item in enumerate(value)]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, torch.Size):
        return list(value)
    raise TypeError(f"{name} is a {type(value).__name__}, which a checkpoint cannot hold")


def _decode(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    if isinstance(value, dict):
        if _TENSOR in value:
            return tensors[value[_TENSOR]]
        if _PAIRS in value:
            return {key: _decode(item, tensors) for key, item in value[_PAIRS]}
        return {key: _decode(item, tensors) for key, item in value.items()}
    if isinstance(value, list):
        return [_decode(item, tensors) for item in value]
    return value
