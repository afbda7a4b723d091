"""Reads episode names, masks and attributes of a file in robomimic's layout."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.hdf5 import (
    DAMAGE,
    open_file,
    read_attribute,
    read_attributes,
    read_names,
    read_node,
    read_strings,
)
from torchrl_bmrl.data.options import check_bounds
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import parse_json

with needs("data"):
    import h5py

MASKS = ("train", "valid")
CONTEXT_MASK = "context"
"""Of episodes of another behaviour."""


def episode_names(path: str | Path, file: h5py.File, split: str | None = None) -> list[str]:
    """Names of all demonstrations, or of those in a mask.

    Raises:
        DataError: if there are none, if the mask is missing, or if it names a missing one.
    """
    names, _ = _demonstrations(path, file)
    if split is not None:
        masks = read_masks(path, file)
        if split not in masks:
            valid = ", ".join(masks) or "none; the file has no masks"
            raise DataError(path, f"mask/{split}", f"missing; valid masks: {valid}")
        names = _read_mask(path, file, split, set(names))
    if not names:
        raise DataError(path, f"mask/{split}" if split else "data", "no demonstrations")
    return names


def _demonstrations(path: str | Path, file: h5py.File) -> tuple[list[str], list[str]]:
    """Names of the demonstrations below ``data``, and of other entries there."""
    names: list[str] = []
    beside: list[str] = []
    for name in read_names(path, file, "data"):
        # Such a name means a demonstration, damaged or not.
        found = re.fullmatch(r"demo_?\d+", name) or _is_demonstration(path, file, f"data/{name}")
        (names if found else beside).append(name)
    return names, beside


def _is_demonstration(path: str | Path, file: h5py.File, key: str) -> bool:
    node = read_node(path, file, key)
    if not isinstance(node, h5py.Group):
        return node is None  # damaged: reported when it is read
    return bool({"actions", "obs", "states"} & set(read_names(path, file, key)))


def _read_mask(path: str | Path, file: h5py.File, mask: str, known: set[str]) -> list[str]:
    names = read_strings(path, file, f"mask/{mask}")
    seen: set[str] = set()
    for row, name in enumerate(names):
        if name not in known or name in seen:
            fault = "again" if name in known else "which is not in the file"
            raise DataError(path, f"mask/{mask}", f"row {row} names {name!r}, {fault}")
        seen.add(name)
    return names


def read_masks(path: str | Path, file: h5py.File) -> list[str]:
    """Names of a file's masks."""
    return read_names(path, file, "mask") if "mask" in read_names(path, file, "/") else []


def count_episodes(path: str | Path) -> int:
    """Number of demonstrations in a file.

    Raises:
        DataError: if the file is missing, damaged or has no ``data`` group.
    """
    with open_file(path) as file:
        return len(_demonstrations(path, file)[0])


def count_steps(
    path: str | Path, episodes: Mapping[str, Episode], file: h5py.File | None = None
) -> int:
    """Total number of steps of a file's episodes, read from the shapes of their arrays if possible.

    Args:
        path: the file.
        episodes: those to count, as :func:`open_episodes` returns them.
        file: the same file if it is open already.

    Raises:
        DataError: if the file is damaged or lacks the actions of one.
    """
    total = 0
    with nullcontext(file) if file else open_file(path) as file:
        for name in episodes:
            key = f"data/{name}/actions"
            try:
                whole = "next_obs" in read_names(path, file, f"data/{name}")
                total += len(read_node(path, file, key)) if whole else 0
            except DAMAGE as error:
                raise DataError(path, key, f"missing or unreadable ({error})") from error
            total += 0 if whole else len(episodes[name])
    return total


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Attributes of a file, with ``env_args`` and ``action_bounds`` parsed, and its masks.

    Returns:
        the attributes by name, and ``masks``: names of demonstrations by mask. ``action_bounds``,
        if the file states them, has ``low`` and ``high``: a number each, or a list with one for
        each dimension.

    Raises:
        DataError: if the file is missing or damaged, or ``env_args`` or ``action_bounds`` are
            invalid.
    """
    with open_file(path) as file:
        return metadata_of(path, file)


def metadata_of(path: str | Path, file: h5py.File) -> dict[str, Any]:
    """Metadata of an open file, as :func:`read_metadata` returns them."""
    read_names(path, file, "data")
    attributes = read_attributes(path, file, "data")
    masks = read_masks(path, file)
    attributes["masks"] = {name: read_strings(path, file, f"mask/{name}") for name in masks}
    attributes["env_args"] = _parse(path, "env_args", attributes.get("env_args", "{}"))
    if "action_bounds" in attributes:
        bounds = _parse(path, "action_bounds", attributes["action_bounds"])
        try:
            check_bounds((bounds["low"], bounds["high"]), "action_bounds")
        except (KeyError, ConfigError) as error:
            message = f"attribute action_bounds is {reprlib.repr(bounds)}"
            message += "; valid: low and high, low < high"
            raise DataError(path, "data", message) from error
        attributes["action_bounds"] = bounds
    return attributes


def _parse(path: str | Path, name: str, text: Any) -> dict[str, Any]:
    try:
        parsed = parse_json(text)
    except (TypeError, ValueError) as error:
        raise DataError(path, "data", f"attribute {name} is not JSON ({error})") from error
    if not isinstance(parsed, dict):
        raise DataError(path, "data", f"attribute {name}; valid: a JSON object")
    return parsed


def find_mask_problems(path: str | Path, file: h5py.File) -> Iterator[tuple[str, str]]:
    """Faults of an open file's masks: key and message of each."""
    known = set(_demonstrations(path, file)[0])
    for mask in read_masks(path, file):
        try:
            _read_mask(path, file, mask, known)
        except DataError as error:
            yield error.key or "mask", error.message


def find_oddities(path: str | Path, file: h5py.File) -> Iterator[str]:
    """Warnings about an open file as a whole."""
    names, beside = _demonstrations(path, file)
    others = [name for name in read_names(path, file, "/") if name not in ("data", "mask")]
    if beside := [*(f"data/{name}" for name in beside), *others]:
        yield f"beside the demonstrations, not read: {', '.join(beside)}"
    cut = [name for name in names if "next_obs" not in read_names(path, file, f"data/{name}")]
    if cut:
        yield f"{len(cut)} episodes have no next_obs, such as {cut[0]}"
    yield from _find_contradictions(path, file, names)
    if set(MASKS) <= set(read_masks(path, file)):
        train, valid = (set(read_strings(path, file, f"mask/{mask}")) for mask in MASKS)
        if both := sorted(train & valid):
            yield f"{len(both)} episodes are in train and in valid, such as {both[0]}"


def _find_contradictions(path: str | Path, file: h5py.File, names: list[str]) -> Iterator[str]:
    """Attributes whose number of steps differs from that of the arrays, which are used."""
    total, wrong = 0, []
    try:
        for name in names:
            node = read_node(path, file, f"data/{name}/actions")
            if not isinstance(node, h5py.Dataset) or not node.ndim:
                return
            total += len(node)
            said = read_attribute(path, file, f"data/{name}", "num_samples")
            if not _says(said, len(node)):
                wrong.append(f"{name} says {said} of {len(node)}")
        said = read_attribute(path, file, "data", "total")
    except DataError:  # reported when the episodes are read
        return
    if wrong:
        yield (
            f"attribute num_samples contradicts the arrays in {len(wrong)} episodes, such as "
            f"{wrong[0]} steps; the arrays are used"
        )
    if not _says(said, total):
        yield f"attribute total is {said} steps, but the arrays have {total}; the arrays are used"


def _says(said: Any, count: int) -> bool:
    """Whether an attribute is missing or is this number, in any of the forms that tools write."""
    if isinstance(said, list) and len(said) == 1:
        said = said[0]
    return said is None or said == count or said == str(count)
