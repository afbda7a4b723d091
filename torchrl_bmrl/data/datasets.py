"""Files of demonstrations as memory-mapped TorchRL data sets."""

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

from torchrl_bmrl.data.convert import Stream
from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.hdf5 import open_file, update_digests
from torchrl_bmrl.data.options import Bounds, LastStep, ReadOptions, Reward
from torchrl_bmrl.data.robomimic import count_steps
from torchrl_bmrl.data.sampler import HandsOutCopies, read_memmap
from torchrl_bmrl.data.source_files import CHANGED
from torchrl_bmrl.data.sources import find_format, open_source
from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import new_folder, parse_json
from torchrl_bmrl.functional import mean_and_scale

with needs("data"):
    import h5py

LAYOUT_VERSION = 3
"""Part of the hash in a cache's name: another version converts anew."""
ATTEMPTS = 3
"""Attempts to convert before a file system that corrupts data is reported."""


class FixedStorage(HandsOutCopies, TensorStorage):
    """Read-only data of a file; dumps and states leave them out."""

    def set(self, *args: Any, **kwargs: Any) -> None:
        """Raises a BMRLError: the data are read-only."""
        raise BMRLError("the data of a file are read-only; copy them: replay[:].clone()")

    def dumps(self, path: str | Path) -> None:
        """Writes nothing."""

    def loads(self, path: str | Path) -> None:
        """Reads nothing."""

    def state_dict(self) -> dict[str, Any]:
        """An empty state."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads nothing."""


class RobomimicExperienceReplay(BaseDatasetExperienceReplay):
    """Replay buffer over the demonstrations of a file in robomimic's HDF5 layout.

    The file is converted once, episode by episode, into memory-mapped tensors beside it (or under
    ``root``), in a folder named after a hash of its content and the options. The file itself is
    only read. If two processes convert it at once, one result is used.

    Keys, batch ``[N]``: each part of the observation under its own name, as in ``GymEnv``, and
    under ``"next"``; ``action``; ``("next", "reward")``, ``("next", "done")``,
    ``("next", "terminated")``, ``("next", "truncated")`` and, if the file has ``successes``,
    ``("next", "success")``, each ``(N, 1)``; ``episode`` and ``step`` ``(N,)``. Observations keep
    their dtype; floating-point actions and rewards are float32. An episode's last step is
    ``truncated`` unless the file states that it is terminated. ``sha256`` is the hash of the file.

    Args:
        dataset_id: the file.
        batch_size: of the samples, if not given to ``sample``.
        root: folder of the converted data; the file's folder by default.
        split: name of a mask, such as ``"train"``; ``None`` for all demonstrations.
        observation_keys: parts of the observation; ``None`` for all.
        dones_terminate: as this and the next four options of
            :class:`~torchrl_bmrl.data.options.ReadOptions`.
        last_step: see there.
        reward: see there.
        successful: see there.
        bounds: see there.
        split_trajs: one row per episode, padded with zeros; ``mask`` is ``False`` for the padding.
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
        # Absolute, because the working directory may change before the folder is read again.
        source = Path(dataset_id).expanduser().absolute()
        self.root = source.parent if root is None else Path(root).expanduser().absolute()
        options = asdict(chosen)
        if chosen.observation_keys is not None:
            # Sorted, so that one folder serves all orders.
            options["observation_keys"] = sorted(chosen.observation_keys)
        if not source.is_file():
            raise DataError(source, None, "no such file")
        with open_file(source) as file:  # one handle: the name may get another file at any time
            digest, self.sha256 = _digests(source, file, options, split_trajs)
            self._path = self.root / f"{source.stem}-{digest}"
            read = _read(self._path)
            for _ in range(ATTEMPTS):
                if read is not None:
                    break
                _set_aside(self._path)
                _convert(source, file, self._path, options, split_trajs)
                read = _read(self._path)
        if read is None:
            message = "is damaged as soon as it is written; valid: root=, a folder on a sound disk"
            raise DataError(source, None, f"its conversion {self._path} {message}")
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
        """The same folder: each split has its own."""
        return self._path

    def _is_downloaded(self) -> bool:
        return _read_metadata(self._path) is not None

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of the data.

        The file's attributes, ``env_args`` and ``masks``; ``episodes``, their names in order;
        ``statistics``, for ``ObservationNorm``: mean (``loc``) and standard deviation (``scale``, 1
        for a constant dimension) of the actions and of each part of the observation that is a
        vector of floating-point numbers; ``account``, ``warnings`` and ``oddities``.
        """
        return json.loads(self._metadata)


def _read(path: Path) -> tuple[TensorDict, str] | None:
    """Data and metadata of a conversion; ``None`` if it is missing or damaged."""
    metadata = _read_metadata(path)
    if metadata is None:
        return None
    try:
        data = read_memmap(path / "data")
    except DataError:
        return None
    # Another process may be removing it: tensordict skips missing files.
    leaves = len(list(data.keys(include_nested=True, leaves_only=True)))
    files = sum(name.endswith(".memmap") for name in json.loads(metadata)["crc32"])
    return (data, metadata) if leaves == files else None


def _read_metadata(path: Path) -> str | None:
    """The metadata of a conversion; ``None`` unless all checksums of its files match."""
    try:
        text = (path / "metadata.json").read_bytes()
        if (path / "metadata.crc32").read_text() != f"{zlib.crc32(text):08x}":
            return None
        metadata = parse_json(text.decode())
        lists = all(isinstance(metadata[key], list) for key in ("episodes", "warnings", "oddities"))
        sums = metadata["crc32"].items()
        whole = lists and all(_crc32(path / name) == crc for name, crc in sums)
    except (AttributeError, OSError, ValueError, KeyError, TypeError):
        return None
    return text.decode() if whole else None


def _crc32(file: Path) -> str:
    """CRC-32 of a file. It detects every flipped byte, several times as fast as SHA-256."""
    crc, block = 0, bytearray(1 << 20)
    with file.open("rb", buffering=0) as stream:
        while size := stream.readinto(block):
            crc = zlib.crc32(memoryview(block)[:size], crc)
    return f"{crc:08x}"


def _set_aside(path: Path) -> None:
    """Removes a damaged conversion, if any."""
    # Renamed first, so that other processes never see a partial folder under its name.
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        path.rename(aside)
    except OSError:  # no conversion, or a read-only folder, which converting reports
        return
    shutil.rmtree(aside, ignore_errors=True)


def _digests(
    source: Path, file: h5py.File, options: Mapping[str, Any], split_trajs: bool
) -> tuple[str, str]:
    """Hash of an open file's content with the options, and SHA-256 of the content alone."""
    both = hashlib.sha256(json.dumps([LAYOUT_VERSION, dict(options), split_trajs]).encode())
    content = hashlib.sha256()
    update_digests((both, content), source, file)
    return both.hexdigest()[:16], content.hexdigest()


def _convert(
    source: Path, file: h5py.File, target: Path, options: Mapping[str, Any], split_trajs: bool
) -> None:
    """Converts an open file into a folder that appears as a whole, or not at all."""
    try:
        with new_folder(target, exist_ok=True) as folder:
            if (form := find_format(source, file)) != "robomimic":
                raise DataError(source, None, _other_format(source, form))
            with open_source(source, to_train=True, file=file, **options) as data_set:
                data_set.check()
                steps = count_steps(source, data_set.episodes, file)
                stream = Stream([data_set])
                data = _write_rows(folder / "data", stream, steps)
                metadata = dict(data_set.metadata) | {
                    "episodes": list(data_set.episodes),
                    "account": stream.account.as_dict(),
                    "warnings": list(stream.account.warnings()),
                    "oddities": list(data_set.oddities),
                }
            # The folder's name promises this content.
            if not target.name.endswith(_digests(source, file, options, split_trajs)[0]):
                raise DataError(source, None, CHANGED)
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


def _write_rows(path: Path, stream: Stream, steps: int) -> TensorDict:
    """Writes one episode after the other into memory-mapped tensors of ``steps`` rows in total.

    Raises:
        DataError: for the first episode that cannot be trained on.
        OSError: if the folder cannot be written or the disk is full.
    """
    data, start = TensorDict(), 0
    for number, episode in enumerate(stream):
        rows = as_tensordict(episode, number=number)
        if not number:
            data = _allocate(rows[:1].expand(steps), path)
        data[start : start + len(rows)] = rows
        start += len(rows)
    return data


def _statistics(data: TensorDict) -> dict[str, dict[str, list[float]]]:
    """Mean and standard deviation of the actions and of the observation's vectors."""
    statistics = {}
    for key, part in data.items():
        if isinstance(part, Tensor) and part.is_floating_point() and part.ndim == 2:
            loc, scale = mean_and_scale(part)
            statistics[key] = {"loc": loc.tolist(), "scale": scale.tolist()}
    return statistics


def _split(path: Path) -> None:
    """Replaces the steps of all episodes by one padded row per episode."""
    data = read_memmap(path)
    split = split_trajectories(data.to_tensordict(), trajectory_key="episode")
    shutil.rmtree(path)
    _allocate(split, path).update_(split)


def _allocate(data: TensorDict, path: Path) -> TensorDict:
    """Memory-mapped tensors like those of ``data``, with their disk space reserved."""
    try:
        mapped = data.memmap_like(path)
    except RuntimeError as error:  # torch's error if the file system refuses
        raise OSError(str(error)) from error
    # The maps are sparse files: on a full disk, writing to them would kill the process instead of
    # raising an error. macOS cannot reserve space in this way.
    for file in path.rglob("*.memmap") if hasattr(os, "posix_fallocate") else ():
        if size := file.stat().st_size:
            with file.open("r+b") as handle:
                os.posix_fallocate(handle.fileno(), 0, size)
    return mapped
