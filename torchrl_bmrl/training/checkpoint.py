"""Checkpoints: one safetensors file each, written atomically and read without pickle."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tensordict
import torch
import torchrl
from torch import Tensor, nn
from torch.optim import Adam

from torchrl_bmrl import __version__
from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import link_or_copy, parse_json, write_atomic
from torchrl_bmrl.training import get_rng_state, load_adam, set_rng_state

with needs("recipes"):
    import safetensors
    import safetensors.torch

log = logging.getLogger(__name__)

_HEADER, _SUM = "checkpoint", "sha256"
_TENSOR, _PAIRS = "__tensor__", "__pairs__"

State = dict[str, Any]
Metadata = dict[str, Any]


def save_checkpoint(
    path: Path, state: Mapping[str, Any], metadata: Mapping[str, Any], *, keep: int = 1
) -> None:
    """Saves nested state dicts and a description of the networks that they belong to.

    The file also contains a checksum and, unless ``metadata`` has an entry ``"versions"``, the
    versions of this library, torch, tensordict and torchrl.

    Args:
        path: the file.
        state: nested dicts and lists of tensors and plain values, such as ``state_dict()`` of
            modules and optimizers.
        metadata: JSON-compatible description, returned by :func:`load_checkpoint`.
        keep: number of checkpoints to keep: ``a.safetensors`` is the newest, ``a.1.safetensors``
            the one before.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> save_checkpoint(path, {"step": 3, "weights": torch.ones(2)}, {"kind": "example"})
        >>> load_checkpoint(path, kind="example")[0]
        {'step': 3, 'weights': tensor([1., 1.])}
    """
    path, tensors = Path(path), dict[str, Tensor]()
    header = {"state": _encode(state, "", tensors), "metadata": {"versions": _VERSIONS, **metadata}}
    header[_SUM] = _checksum(header, tensors)
    # One entry: safetensors writes several in random order, and equal runs would differ in bytes.
    data = safetensors.torch.save(tensors, {_HEADER: json.dumps(header)})
    if keep > 1 and path.exists():
        for number in range(keep - 1, 1, -1):
            if (newer := earlier(path, number - 1)).exists():
                newer.replace(earlier(path, number))
        # A link, so that the newest checkpoint exists at any moment.
        earlier(path, 1).unlink(missing_ok=True)
        link_or_copy(path, earlier(path, 1))
    write_atomic(path, data)


def earlier(path: Path, number: int) -> Path:
    """Returns the path of an earlier checkpoint; number 1 is the one before the newest.

    Example:
        >>> earlier(Path("run/checkpoint.safetensors"), 1).name
        'checkpoint.1.safetensors'
    """
    return path.with_name(f"{path.stem}.{number}{path.suffix}")


_VERSIONS = {
    "torchrl_bmrl": __version__,
    "torch": torch.__version__,
    "tensordict": tensordict.__version__,
    "torchrl": torchrl.__version__,
}


def _checksum(header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> str:
    """Checksum of everything in a checkpoint except the checksum itself."""
    text = json.dumps({key: value for key, value in header.items() if key != _SUM})
    digest = hashlib.sha256(text.encode())
    digest.update(safetensors.torch.save(dict(tensors)))
    return digest.hexdigest()


def load_checkpoint(path: Path, *, kind: str) -> tuple[State, Metadata]:
    """Loads a checkpoint of :func:`save_checkpoint`.

    Args:
        path: the file.
        kind: expected ``metadata["kind"]``.

    Returns:
        state and metadata.

    Raises:
        CheckpointError: if the file is missing, damaged, a pickle, or of another kind.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> save_checkpoint(path, {"step": 3}, {"kind": "example", "task": "lift"})
        >>> state, metadata = load_checkpoint(path, kind="example")
        >>> state, metadata["task"]
        ({'step': 3}, 'lift')
    """
    state, metadata = _read(Path(path))
    return state, _of_kind(path, metadata, kind)


def load_newest(path: Path, *, kind: str) -> tuple[State, Metadata] | None:
    """Loads the newest checkpoint, or the one before if that is damaged.

    A damaged checkpoint causes a warning and is renamed to ``a.damaged.safetensors``; the one that
    is loaded becomes the newest.

    Args:
        path: the newest checkpoint.
        kind: expected ``metadata["kind"]``.

    Returns:
        state and metadata; ``None`` if there is no checkpoint.

    Raises:
        CheckpointError: if all checkpoints are damaged, or of another kind; no file changes then.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> load_newest(path, kind="example")
        >>> for step in range(3):
        ...     save_checkpoint(path, {"step": step}, {"kind": "example"}, keep=2)
        >>> path.write_bytes(b"damaged")
        7
        >>> load_newest(path, kind="example")[0]
        {'step': 1}
    """
    path = Path(path)
    pattern = f"{path.stem}.*{path.suffix}"
    numbers = [
        file.name[len(path.stem) + 1 : -len(path.suffix)] for file in path.parent.glob(pattern)
    ]
    found = [earlier(path, n) for n in sorted(int(n) for n in numbers if n.isdecimal())]
    found = [path, *found] if path.exists() else found
    damaged: list[CheckpointError] = []
    for file in found:
        try:
            state, metadata = _read(file)
        except CheckpointError as error:
            damaged.append(error)
            continue
        _of_kind(file, metadata, kind)
        if damaged:
            log.warning(f"{damaged[0]}; training continues from {file.name}")
            for bad in damaged:
                os.replace(bad.path, path.with_name(f"{path.stem}.damaged{path.suffix}"))
        if file != path:
            file.replace(path)
        return state, metadata
    if damaged:
        raise damaged[0]
    return None


def _read(path: Path) -> tuple[State, Metadata]:
    if not path.is_file():
        raise CheckpointError(path, "no such checkpoint")
    try:
        with safetensors.safe_open(path, "pt") as file:
            header = parse_json((file.metadata() or {})[_HEADER])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        if header[_SUM] != _checksum(header, tensors):
            raise ValueError("the checksum differs")
        state, metadata = _decode(header["state"], tensors), header["metadata"]
        if not isinstance(state, dict) or not isinstance(metadata, dict):
            raise ValueError("state and metadata are not mappings")
        return state, metadata
    except (
        safetensors.SafetensorError,
        AttributeError,
        KeyError,
        OSError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise CheckpointError(
            path, f"not a complete safetensors checkpoint of this library ({reason})"
        ) from error


def _of_kind(path: Path, metadata: Metadata, kind: str) -> Metadata:
    if metadata.get("kind") != kind:
        raise CheckpointError(path, f"kind is {metadata.get('kind')!r}; valid: {kind!r}")
    return metadata


def load_state(module: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Loads a ``state_dict()`` into a module.

    Args:
        module: the module.
        state: parameters and buffers by name.
        path: path of the checkpoint, for the message.

    Raises:
        CheckpointError: naming the first key or shape that differs; nothing is loaded then.

    Example:
        >>> module, path = nn.Linear(2, 1), Path("a.safetensors")
        >>> load_state(module, nn.Linear(2, 1).state_dict(), path)
        >>> load_state(module, nn.Linear(3, 1).state_dict(), path)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.CheckpointError: a.safetensors: 'weight' has shape (1, 3); valid ...
    """
    check_shapes(module, state, path)
    module.load_state_dict(dict(state))


def check_shapes(module: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Compares names and shapes as :func:`load_state` does, which also works on the meta device."""
    own = module.state_dict()
    if not isinstance(state, Mapping):
        raise CheckpointError(path, f"contains {type(state).__name__}; valid: parameters by name")
    for key in [*own, *state]:
        if key not in state or key not in own:
            where = "checkpoint" if key not in state else "networks"
            raise CheckpointError(path, f"key {key!r} is missing in the {where}")
        if not isinstance(own[key], Tensor):
            continue
        if not isinstance(state[key], Tensor) or own[key].shape != state[key].shape:
            shape = tuple(state[key].shape) if isinstance(state[key], Tensor) else "none"
            raise CheckpointError(
                path,
                f"{key!r} has shape {shape}; valid for these networks: {tuple(own[key].shape)}",
            )


def save_training(
    path: Path,
    module: nn.Module,
    optimizers: Mapping[str, Adam],
    metadata: Mapping[str, Any],
    *,
    device: str,
    keep: int,
) -> None:
    """Saves the state of a training: parameters, optimizers, and random number generators.

    Args:
        path: path of the newest checkpoint.
        module: the networks.
        optimizers: their optimizers by name.
        metadata: metadata for :func:`save_checkpoint`, with ``updates``.
        device: device of the training.
        keep: number of checkpoints to keep.
    """
    state = {
        "module": module.state_dict(),
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
        "rng": get_rng_state(device),
    }
    save_checkpoint(path, state, metadata, keep=keep)


def resume_training(
    path: Path,
    module: nn.Module,
    optimizers: Mapping[str, Adam],
    *,
    kind: str,
    device: str,
) -> dict[str, Any] | None:
    """Restores the state of :func:`save_training` from the newest checkpoint that is not damaged.

    Args:
        path: path of the newest checkpoint.
        module: the networks.
        optimizers: their optimizers by name.
        kind: expected ``metadata["kind"]``.
        device: device of the training.

    Returns:
        the metadata; ``None`` if there is no checkpoint.

    Raises:
        CheckpointError: if all checkpoints are damaged, or belong to another training.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> from torchrl_bmrl.training import make_adam
        >>> net = nn.Linear(2, 1)
        >>> optimizers = {"net": make_adam(net.parameters(), lr=0.1)}
        >>> resume_training(path, net, optimizers, kind="example", device="cpu")
        >>> metadata = {"kind": "example", "updates": 3}
        >>> save_training(path, net, optimizers, metadata, device="cpu", keep=2)
        >>> resume_training(path, net, optimizers, kind="example", device="cpu")["updates"]
        3
    """
    found = load_newest(path, kind=kind)
    if found is None:
        return None
    state, metadata = found
    try:
        load_state(module, state["module"], path)
        for name, optimizer in optimizers.items():
            load_adam(optimizer, state["optimizers"][name])
        set_rng_state(state["rng"], device)
        metadata["updates"] = int(metadata["updates"])
    except CheckpointError:
        raise
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(path, f"not a checkpoint of this training ({error})") from error
    return metadata


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
    raise TypeError(f"{name} is a {type(value).__name__}, which a checkpoint cannot contain")


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
