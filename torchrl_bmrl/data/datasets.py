"""Files of demonstrations as TorchRL data sets: memory-mapped, sliced, loaded by name."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from tensordict import TensorDict
from torchrl.collectors.utils import split_trajectories
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.episodes import Episode, as_tensordict
from torchrl_bmrl.data.robomimic import count_steps, open_episodes, read_metadata
from torchrl_bmrl.data.schema import check_episode, layout_of
from torchrl_bmrl.errors import DataError

LAYOUT_VERSION = 1
"""Part of a cache's name: another version converts anew."""


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

    Example:
        >>> import torchrl_bmrl.data  # registers the prefix
        >>> from torchrl.data.datasets import load_dataset
        >>> replay = load_dataset("robomimic:lift.hdf5", split="train")  # doctest: +SKIP
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
        split_trajs: bool = False,
        sampler: Sampler | None = None,
        writer: Writer | None = None,
        collate_fn: Callable | None = None,
        pin_memory: bool = False,
        prefetch: int | None = None,
        transform: Transform | None = None,
    ) -> None:
        self.dataset_id = str(dataset_id)
        source = Path(dataset_id).expanduser()
        self.root = source.parent if root is None else Path(root).expanduser()
        options = {
            "split": split,
            "observation_keys": None if observation_keys is None else list(observation_keys),
            "dones_terminate": dones_terminate,
        }
        self._path = self.root / f"{source.stem}-{_digest(source, options, split_trajs)}"
        if not self._is_downloaded():
            _convert(source, self._path, options, split_trajs)
        data = TensorDict.load_memmap(self._path / "data")
        super().__init__(
            storage=TensorStorage(data),
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
        return self._path.is_dir()

    @property
    def metadata(self) -> dict[str, Any]:
        """Attributes of the file, its ``env_args`` and the names of the ``episodes``, in order."""
        return json.loads((self._path / "metadata.json").read_text())


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
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        temporary.mkdir(parents=True)
        with open_episodes(source, extras=["successes"], **options) as episodes:
            steps = count_steps(source, episodes)
            _write_rows(temporary / "data", source, episodes, steps)
            metadata = read_metadata(source) | {"episodes": list(episodes)}
        if split_trajs:
            _split(temporary / "data")
        (temporary / "metadata.json").write_text(json.dumps(metadata, default=str))
        _flush(temporary)
        try:
            temporary.rename(target)
        except OSError:
            if not target.is_dir():  # otherwise another process was faster, with the same data
                raise
    except OSError as error:
        message = (
            f"cannot be converted into {target.parent} ({error}); valid: root=, a folder with "
        )
        raise DataError(source, None, message + "space that can be written") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_rows(path: Path, source: Path, episodes: Mapping[str, Episode], steps: int) -> None:
    """Writes episodes one after the other into memory-mapped tensors.

    Only one episode is in memory at a time, however large the data set.

    Args:
        path: folder of the tensors.
        source: file, for messages.
        episodes: by name.
        steps: of all of them together.

    Raises:
        DataError: for the first episode that cannot be trained on.
        OSError: if the folder cannot be written or the disk is full.
    """
    layout, start = None, 0
    for number, name in enumerate(episodes):
        episode = episodes[name]
        check_episode(source, f"data/{name}", episode, layout=layout)
        rows = as_tensordict(episode, number=number)
        if layout is None:
            layout = layout_of(episode)
            data = _allocate(rows[:1].expand(steps), path)
        data[start : start + len(rows)] = rows
        start += len(rows)


def _split(path: Path) -> None:
    """Replaces flat data by one padded row per episode."""
    data = TensorDict.load_memmap(path)
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


def _flush(path: Path) -> None:
    # A power cut after the rename must not leave empty files under the final name.
    for file in path.rglob("*"):
        if file.is_file():
            with file.open("rb") as handle:
                os.fsync(handle.fileno())
