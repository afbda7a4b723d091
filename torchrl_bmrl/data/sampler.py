"""Sampler and storages of the replay buffers over several data sets."""

from __future__ import annotations

import ctypes
import json
import mmap
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.files import read_json

Device = torch.device | str | None
MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # Python has the name from 3.13 on


def read_memmap(path: Path) -> TensorDict:
    """Opens a folder of memory-mapped tensors so that writes do not reach the files.

    The maps are private: a process gets its own copy of each page that it writes to. Other objects,
    which would be pickles, are refused.

    Args:
        path: folder that tensordict wrote.

    Raises:
        DataError: if it contains a pickle, tensordict did not write it, or a file was cut.
    """
    try:
        _check_sizes(path)
        # These maps are shared with the files; they are only used for the files' names.
        return TensorDict.load_memmap(path, allow_pickle=False).apply(_private)
    except DataError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(path, None, f"not a folder of memory-mapped tensors ({error})") from error


def _check_sizes(path: Path) -> None:
    """Compares files with their descriptions; tensordict lets a short one grow, with zeros."""
    for description in sorted(Path(path).rglob("meta.json")):
        for key, told in json.loads(description.read_bytes()).items():
            if not isinstance(told, dict) or "shape" not in told:
                continue  # not a tensor
            file = description.with_name(f"{key}.memmap")
            dtype = getattr(torch, told["dtype"].removeprefix("torch."))
            valid = prod(told["shape"]) * dtype.itemsize
            found = file.stat().st_size if file.is_file() else 0
            if found != valid:
                message = f"{found} bytes; valid: {valid}, {told['dtype']} {tuple(told['shape'])}"
                raise DataError(file, None, message)


def _private(leaf: Tensor) -> Tensor:
    """Maps the file of a memory-mapped tensor again, so that writes stay in this process."""
    name = getattr(leaf, "filename", None)
    if name is None:  # a tensor without elements has no file
        return leaf
    size = leaf.numel() * leaf.element_size()
    try:
        content = torch.from_file(str(name), shared=False, size=size, dtype=torch.uint8)
        # PyTorch assumes that all of its maps can be shared, and fails to send such a tensor to
        # another process. It copies numpy's memory instead.
        content = torch.from_numpy(content.numpy())
    except RuntimeError:
        # Linux reserves memory for all that may be written, and refuses maps larger than its free
        # memory. This map reserves none, but keeps a file open for each tensor.
        if not hasattr(mmap, "MAP_PRIVATE"):
            raise
        with open(name, "rb") as file:
            flags = mmap.MAP_PRIVATE | MAP_NORESERVE
            protection = mmap.PROT_READ | mmap.PROT_WRITE
            mapped = mmap.mmap(file.fileno(), size, flags=flags, prot=protection)
        content = torch.frombuffer(mapped, dtype=torch.uint8)
    return content.view(leaf.dtype).view(leaf.shape)


def read_sampler(path: Path) -> dict[str, Any]:
    """What :meth:`TaskSampler.dumps` wrote.

    Args:
        path: the folder.

    Raises:
        DataError: if it is missing or damaged.
    """
    file = path / "sampler_metadata.json"
    state = read_json(file, "the state of a sampler")
    if not isinstance(state, dict) or not {"sizes", "weights"} <= state.keys():
        raise DataError(file, None, "valid: sizes and weights")
    return state


class TaskSampler(Sampler):
    """Samples with replacement from data sets that are concatenated in one storage.

    Args:
        sizes: number of transitions of each data set, which are equally likely within it.
        weights: relative frequency of each data set.
        flat: ``False`` for indices ``[num_datasets, batch_size]``: row i from data set i or, with
            weights, from a drawn data set. ``True`` for indices ``[batch_size]``: each from a drawn
            data set or, without weights, from the whole storage.
        device: of the indices.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        weights: Sequence[float] | None = None,
        flat: bool = False,
        device: Device = None,
    ) -> None:
        self.sizes, self.flat = list(sizes), flat
        self._sizes = torch.tensor(self.sizes, device=device)
        self._starts = self._sizes.cumsum(0) - self._sizes
        self._set_weights(weights)

    def _set_weights(self, weights: Sequence[float] | None) -> None:
        self.weights = weights
        device = self._sizes.device
        self._weights = None if weights is None else torch.tensor(weights, device=device).float()

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draws indices; TorchRL's second return value, information on them, is empty."""
        rows = batch_size if self.flat else len(self.sizes)
        shape = (rows,) if self.flat else (rows, batch_size)
        if self.flat and self._weights is None:
            return self._integers(len(storage), shape), {}
        if self._weights is None:
            number = torch.arange(rows, device=self._sizes.device)
        else:
            number = self._weights.multinomial(rows, replacement=True, generator=self._rng)
        number = number if self.flat else number.unsqueeze(-1)
        # The range is so wide that the remainder is practically uniform for every size.
        return self._starts[number] + self._integers(2**62, shape) % self._sizes[number], {}

    def _integers(self, high: int, shape: tuple[int, ...]) -> Tensor:
        return torch.randint(high, shape, generator=self._rng, device=self._sizes.device)

    def state_dict(self) -> dict[str, Any]:
        """Sizes and weights."""
        return {"sizes": self.sizes, "weights": self.weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads the weights.

        Raises:
            BMRLError: for data sets of other sizes.
        """
        if state_dict["sizes"] != self.sizes:
            message = f"data sets of {state_dict['sizes']} transitions; valid: {self.sizes}"
            raise BMRLError(message)
        self._set_weights(state_dict["weights"])

    def dumps(self, path: str | Path) -> None:
        """Writes the state into a folder."""
        Path(path).mkdir(exist_ok=True)
        (Path(path) / "sampler_metadata.json").write_text(json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Loads what :meth:`dumps` wrote, as :meth:`load_state_dict` does."""
        self.load_state_dict(read_sampler(Path(path)))

    def _empty(self) -> None:
        """Does nothing: the data sets stay."""


class HandsOutCopies(Storage):
    """Mixin of storages that never return their own tensordict.

    TorchRL's storages return theirs for all rows, ``buffer[:]``. A buffer's transforms write to it,
    so that normalised data would be normalised again at the next call, and in all samples.
    """

    def get(self, index: Any) -> Any:
        """Rows of the data; the tensors may be those of the storage."""
        data = super().get(index)
        return data.copy() if data is self._storage else data


class DeviceStorage(HandsOutCopies, LazyTensorStorage):
    """Data in the memory of a device."""


class MemmapStorage(HandsOutCopies, LazyMemmapStorage):
    """Data in memory-mapped files."""

    def expect_random_reads(self) -> None:
        """Tells Linux to read single pages: it reads 128 kB around each row otherwise.

        That counts for data larger than memory, of which hardly any row is read twice.
        """
        if not hasattr(mmap, "MADV_RANDOM"):
            return
        advise = ctypes.CDLL(None).madvise
        for tensor in self._storage.values(include_nested=True, leaves_only=True):
            start = tensor.data_ptr() // mmap.PAGESIZE * mmap.PAGESIZE
            size = tensor.data_ptr() + tensor.numel() * tensor.element_size() - start
            advise(ctypes.c_void_p(start), ctypes.c_size_t(size), mmap.MADV_RANDOM)


class DatasetBuffer(TensorDictReplayBuffer):
    """Replay buffer whose ``dumps`` and ``loads`` use no pickle and skip prefetched samples."""

    def dumps(self, path: str | Path) -> None:
        """Writes data, sampler and the buffer's own generator, if any, into a folder."""
        path = Path(path).absolute()
        path.mkdir(parents=True, exist_ok=True)
        self.storage.dumps(path / "storage")
        self.sampler.dumps(path / "sampler")
        if self._rng is not None:
            state = TensorDict({"rng_state": self._rng.get_state().clone()}, [])
            state.memmap(path / "rng_state")

    def loads(self, path: str | Path) -> None:
        """Loads what :meth:`dumps` wrote, for data sets of the same sizes.

        Raises:
            DataError: if the folder is missing or contains other data.
            BMRLError: for data sets of other sizes.
        """
        path = Path(path).absolute()
        if not path.is_dir():
            raise DataError(path, None, "not a dump of these data (no such folder)")
        try:
            # Nothing changes unless all can be read. TorchRL's reader would also load pickles.
            state = read_sampler(path / "sampler")
            read_memmap(path / "storage")
            if (path / "rng_state").exists():
                read_memmap(path / "rng_state")
            self.sampler.load_state_dict(state)
            with self._futures_lock:
                self._clear_prefetch_queue_locked()  # its samples are of the data before
                self.storage.loads(path / "storage")
                if self._rng is not None and (path / "rng_state").exists():
                    self._rng.set_state(read_memmap(path / "rng_state")["rng_state"])
        except BMRLError:
            raise
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise DataError(path, None, f"not a dump of these data ({error})") from error

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads what ``state_dict`` returned, for data sets of the same sizes."""
        self.sampler.load_state_dict(state_dict["_sampler"])
        super().load_state_dict({**state_dict, "_prefetch_state": None})
