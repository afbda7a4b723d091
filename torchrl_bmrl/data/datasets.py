"""Files of demonstrations as TorchRL data sets: memory-mapped, sliced, loaded by name."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from tensordict import TensorDict
from torch import Tensor
from torchrl.collectors.utils import split_trajectories
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.options import Bounds, LastStep, ReadOptions, Reward
from torchrl_bmrl.data.robomimic import count_steps
from torchrl_bmrl.data.sampler import HandsOutCopies, read_memmap
from torchrl_bmrl.data.schema import check_episode, layout_of
from torchrl_bmrl.data.sources import Source, find_format, open_source
from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.files import new_folder
from torchrl_bmrl.functional import mean_and_scale

LAYOUT_VERSION = 3
"""Part of a cache's name: another version converts anew."""
ATTEMPTS = 3
"""Conversions before a file system that gives back other data than were written is reported."""


class FixedStorage(HandsOutCopies, TensorStorage):
    """Data that belong to a file: nothing writes to them, and a dump leaves them where they are."""

    def set(self, *args: Any, **kwargs: Any) -> None:
        """Refuses.

        Raises:
            BMRLError: always.
        """
        raise BMRLError("the data of a file are read only; copy them: replay[:].clone()")

    def dumps(self, path: str | Path) -> None:
        """Writes nothing: the file has the data."""

    def loads(self, path: str | Path) -> None:
        """Reads nothing: the data are there."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes nothing."""


class RobomimicExperienceReplay(BaseDatasetExperienceReplay):
    """Demonstrations of a file in robomimic's HDF5 layout, as a replay buffer.

    The file is converted once, episode by episode, into memory-mapped tensors beside it (or under
    ``root``), in a folder named after its content and what was asked for; the file itself is only
    read. Two processes may convert at once: one result is kept.

    Keys, batch ``[N]``: each part of the observation under its own name, as ``GymEnv`` shows
    dictionaries, the same under ``"next"``, ``action``, ``("next", "reward")``,
    ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")``, where the file has
    ``successes`` ``("next", "success")``, each ``(N, 1)``, and ``episode`` and ``step`` ``(N,)``.
    Observations keep their dtype; floating-point actions and rewards are float32. An episode's last
    step is ``truncated`` unless the file says that it is terminated.

    Args:
        dataset_id: the file.
        batch_size: of samples; may be given to ``sample`` instead.
        root: folder of the converted data; the file's own by default.
        split: name of a mask, such as ``"train"``; ``None`` for all demonstrations.
        observation_keys: parts of the observation; ``None`` for all.
        dones_terminate: ``dones`` at the last step is a termination (files without ``terminated``).
        last_step: ``"drop"``, ``"truncate"`` or ``"terminate"``: what becomes of a last step after
            which no observation was recorded.
        reward: ``"success"`` or ``"last"``: where rewards come from, if not from the file.
        successful: leaves out the episodes that did not succeed.
        bounds: ``(low, high)`` of floating-point actions, or ``"data"``; by default those that the
            file states, else [-1, 1]. :class:`~torchrl_bmrl.data.options.ReadOptions` says more of
            these options.
        split_trajs: one row per episode, padded with zeros; ``mask`` tells the steps from them.
        sampler: a ``RandomSampler`` by default; ``SliceSampler(traj_key="episode", ...)`` works.
        writer: an ``ImmutableDatasetWriter`` by default.
        collate_fn: of the samples.
        pin_memory: of the samples.
        prefetch: number of batches to prefetch.
        transform: applied to samples.

    Raises:
        DataError: naming file, key and row for data that cannot be trained on (see
            :func:`~torchrl_bmrl.data.schema.find_problems`), and if the folder cannot be written.
        ConfigError: for invalid options.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl.data.datasets import load_dataset
        >>> from torchrl_bmrl.data import Episode
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "lift.hdf5"
        >>> write_episodes(path, [episode], env_args={}, masks={"train": [0]})
        >>> replay = load_dataset(f"robomimic:{path}", split="train", batch_size=32)
        >>> replay.sample()["next", "x"].shape
        torch.Size([32, 3])
    """

    def __init__(
        self,
        dataset_id: str | Path,
        batch_size: int | None = None,
        *,
        root: str | Path | None = None,
        split: str | None = None,
        observation_keys: Iterable[str] | None = None,
        dones_terminate: bool = False,
        last_step: LastStep | None = None,
        reward: Reward | None = None,
        successful: bool = False,
        bounds: Bounds | Literal["data"] | None = None,
        split_trajs: bool = False,
        sampler: Sampler | None = None,
        writer: Writer | None = None,
        collate_fn: Callable | None = None,
        pin_memory: bool = False,
        prefetch: int | None = None,
        transform: Transform | None = None,
    ) -> None:
        chosen = ReadOptions(
            split=split,
            observation_keys=observation_keys,
            dones_terminate=dones_terminate,
            last_step=last_step,
            reward=reward,
            successful=successful,
            bounds=bounds,
        )
        self.dataset_id = str(dataset_id)
        # Absolute: the working directory may change before the folder is looked at again.
        source = Path(dataset_id).expanduser().absolute()
        self.root = source.parent if root is None else Path(root).expanduser().absolute()
        options = asdict(chosen)
        if chosen.observation_keys is not None:
            # In one order, so that one folder serves them all.
            options["observation_keys"] = sorted(chosen.observation_keys)
        self._path = self.root / f"{source.stem}-{_digest(source, options, split_trajs)}"
        read = _read(self._path)
        for _ in range(ATTEMPTS):
            if read is not None:
                break
            _set_aside(self._path)
            _convert(source, self._path, options, split_trajs)
            read = _read(self._path)
        if read is None:
            message = "cannot be read back as it was written, or replaced; valid: root=, a folder"
            raise DataError(source, None, f"its conversion {self._path} {message} on a sound disk")
        data, self._metadata = read
        for text in self.metadata["warnings"]:
            warnings.warn(f"{source}: {text}", stacklevel=2)
        super().__init__(
            storage=FixedStorage(data),
            sampler=sampler,
            writer=writer or ImmutableDatasetWriter(),
            collate_fn=collate_fn,
            pin_memory=pin_memory,
            prefetch=prefetch,
            batch_size=batch_size,
            transform=transform,
        )

    @property
    def data_path(self) -> Path:
        """Folder of the converted data; :meth:`delete` removes it."""
        return self._path

    @property
    def data_path_root(self) -> Path:
        """The same folder: splits have folders of their own."""
        return self._path

    def _is_downloaded(self) -> bool:
        return _read_metadata(self._path) is not None

    @property
    def metadata(self) -> dict[str, Any]:
        """What is known of the data beside them.

        Attributes of the file with its ``env_args`` and ``masks``; ``episodes``, their names in
        order; ``statistics``, mean (``loc``) and standard deviation (``scale``, 1 where a dimension
        is constant) of the actions and of every part of the observation that is a vector of
        floating-point numbers, ready for ``ObservationNorm``.
        """
        return json.loads(self._metadata)


def _read(path: Path) -> tuple[TensorDict, str] | None:
    """Data and metadata of a conversion; ``None`` if there is none, or not as it was written."""
    metadata = _read_metadata(path)
    if metadata is None:
        return None
    try:
        data = read_memmap(path / "data")
    except DataError:
        return None
    # Another process may have removed it meanwhile: what is not there, tensordict leaves out.
    leaves = len(list(data.keys(include_nested=True, leaves_only=True)))
    files = sum(name.endswith(".memmap") for name in json.loads(metadata)["crc32"])
    return (data, metadata) if leaves == files else None


def _read_metadata(path: Path) -> str | None:
    """The metadata of a conversion whose every file is as it was written."""
    try:
        text = (path / "metadata.json").read_bytes()
        if (path / "metadata.crc32").read_text() != f"{zlib.crc32(text):08x}":
            return None
        whole = all(_crc32(path / name) == crc for name, crc in json.loads(text)["crc32"].items())
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return text.decode() if whole else None


def _crc32(file: Path) -> str:
    """Checksum of a file: it finds every flipped byte, at several times the speed of a SHA-256."""
    crc, block = 0, bytearray(1 << 20)
    with file.open("rb", buffering=0) as stream:
        while size := stream.readinto(block):
            crc = zlib.crc32(memoryview(block)[:size], crc)
    return f"{crc:08x}"


def _set_aside(path: Path) -> None:
    """Removes a damaged conversion, if there is one."""
    # Renamed first: other processes find a whole folder under the name, or none.
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        path.rename(aside)
    except OSError:  # none, or a folder that cannot be written: converting will say so
        return
    shutil.rmtree(aside, ignore_errors=True)


def _digest(source: Path, options: Mapping[str, Any], split_trajs: bool) -> str:
    """Names the content of a file and what is made of it."""
    if not source.is_file():
        raise DataError(source, None, "no such file")
    digest = hashlib.sha256(json.dumps([LAYOUT_VERSION, dict(options), split_trajs]).encode())
    try:
        with source.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise DataError(source, None, f"unreadable ({error})") from error
    return digest.hexdigest()[:16]


def _convert(source: Path, target: Path, options: Mapping[str, Any], split_trajs: bool) -> None:
    """Converts a file into a folder that appears whole, or not at all."""
    try:
        with new_folder(target, exist_ok=True) as folder:
            if (form := find_format(source)) != "robomimic":
                raise DataError(source, None, _other_format(source, form))
            with open_source(source, to_train=True, **options) as data_set:
                data_set.check()
                steps = count_steps(source, data_set.episodes)
                data = _write_rows(folder / "data", data_set, steps)
                data_set.account.check(source, data_set.options)
                metadata = dict(data_set.metadata) | {
                    "episodes": list(data_set.episodes),
                    "account": data_set.account.as_dict(),
                    "warnings": list(data_set.account.warnings()),
                    "oddities": list(data_set.oddities),
                }
            metadata["statistics"] = _statistics(data)
            if split_trajs:
                _split(folder / "data")
            metadata["crc32"] = {
                str(file.relative_to(folder)): _crc32(file)
                for file in sorted(folder.rglob("*"))
                if file.is_file()
            }
            text = json.dumps(metadata, default=str).encode()
            (folder / "metadata.json").write_bytes(text)
            (folder / "metadata.crc32").write_text(f"{zlib.crc32(text):08x}")
    except OSError as error:
        raise DataError(
            source,
            None,
            f"cannot be converted into {target.parent} ({error}); valid: root=, a folder with "
            "space that can be written",
        ) from error


def _other_format(source: Path, form: str) -> str:
    task = " --task TASK" if form == "robosuite" else ""
    return (
        f"{form}'s layout; valid: robomimic's, which `python -m torchrl_bmrl.data convert {source} "
        f"OUT.hdf5 --to robomimic{task}` writes"
    )


def _write_rows(path: Path, source: Source, steps: int) -> TensorDict:
    """Writes episodes one after the other into memory-mapped tensors.

    Only one episode is in memory at a time, however large the data set.

    Args:
        path: folder of the tensors.
        source: whose episodes, which its account counts.
        steps: of all of them together.

    Raises:
        DataError: for the first episode that cannot be trained on.
        OSError: if the folder cannot be written or the disk is full.
    """
    layout, start = None, 0
    for number, name in enumerate(source.episodes):
        episode = source.episodes[name]
        check_episode(source.path, f"data/{name}", episode, layout=layout, bounds=source.bounds)
        source.account.add(name, episode)
        rows = as_tensordict(episode, number=number)
        if layout is None:
            layout = layout_of(episode)
            data = _allocate(rows[:1].expand(steps), path)
        data[start : start + len(rows)] = rows
        start += len(rows)
    return data


def _statistics(data: TensorDict) -> dict[str, dict[str, list[float]]]:
    """Mean and standard deviation of the vectors among the observation's parts and the actions."""
    statistics = {}
    for key, part in data.items():
        if isinstance(part, Tensor) and part.is_floating_point() and part.ndim == 2:
            loc, scale = mean_and_scale(part)
            statistics[key] = {"loc": loc.tolist(), "scale": scale.tolist()}
    return statistics


def _split(path: Path) -> None:
    """Replaces flat data by one padded row per episode."""
    data = read_memmap(path)
    split = split_trajectories(data.to_tensordict(), trajectory_key="episode")
    shutil.rmtree(path)
    _allocate(split, path).update_(split)


def _allocate(data: TensorDict, path: Path) -> TensorDict:
    """Memory-mapped tensors like those of ``data``, on disk space that is theirs."""
    try:
        mapped = data.memmap_like(path)
    except RuntimeError as error:  # how torch reports what the file system refuses
        raise OSError(str(error)) from error
    # The maps are sparse files: on a full disk writing to them would kill the process instead of
    # raising an error. macOS has no call for it.
    for file in path.rglob("*.memmap") if hasattr(os, "posix_fallocate") else ():
        if size := file.stat().st_size:
            with file.open("r+b") as handle:
                os.posix_fallocate(handle.fileno(), 0, size)
    return mapped
