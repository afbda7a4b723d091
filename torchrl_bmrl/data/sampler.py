"""What a replay buffer over several data sets is made of: how it draws, and where its data lie."""

from __future__ import annotations

import json
import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from torchrl_bmrl.errors import BMRLError, DataError

Device = torch.device | str | None


MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # Python knows the name from 3.13 on


def read_memmap(path: Path) -> TensorDict:
    """Tensors in memory-mapped files that no operation on them changes.

    The maps are private: pages that a process writes to become its own. There are no objects among
    them, which would be pickles.

    Args:
        path: their folder.

    Raises:
        DataError: if it holds a pickle, or is none of tensordict's folders.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "data"
        >>> _ = TensorDict({"action": torch.ones(4, 2)}, [4]).memmap(path)
        >>> _ = read_memmap(path)["action"].zero_()
        >>> read_memmap(path)["action"].sum()
        tensor(8.)
    """
    try:
        # Its maps are the files themselves, and it knows their names.
        return TensorDict.load_memmap(path, allow_pickle=False).apply(_private)
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(path, None, f"no memory-mapped tensors alone ({error})") from error


def _private(leaf: Tensor) -> Tensor:
    """The file of a memory-mapped tensor, mapped again so that writes stay in this process."""
    name = getattr(leaf, "filename", None)
    if name is None:  # without elements there is no file
        return leaf
    size = leaf.numel() * leaf.element_size()
    try:
        content = torch.from_file(str(name), shared=False, size=size, dtype=torch.uint8)
        # PyTorch takes every map of its own for one that can be shared, and fails to hand such a
        # tensor to another process. It copies what numpy holds.
        content = torch.from_numpy(content.numpy())
    except RuntimeError:
        # Linux reserves memory for all that might be written, and refuses maps larger than what it
        # has. This way of mapping reserves none, but keeps a file open for each tensor.
        if not hasattr(mmap, "MAP_PRIVATE"):
            raise
        with open(name, "rb") as file:
            flags = mmap.MAP_PRIVATE | MAP_NORESERVE
            protection = mmap.PROT_READ | mmap.PROT_WRITE
            mapped = mmap.mmap(file.fileno(), size, flags=flags, prot=protection)
        content = torch.frombuffer(mapped, dtype=torch.uint8)
    return content.view(leaf.dtype).view(leaf.shape)


class TaskSampler(Sampler):
    """Draws, with replacement, from data sets that lie one after the other in a storage.

    Args:
        sizes: transitions of each data set, all of them equally likely within it.
        weights: how often each data set is drawn, relative to the others.
        flat: ``False``: indices ``[num_datasets, batch_size]``, row i of data set i or, with
            weights, each row of a data set that is drawn. ``True``: indices ``[batch_size]``, each
            of a data set that is drawn or, without weights, of the whole storage.
        device: of the indices.

    Example:
        >>> storage = LazyMemmapStorage(5)
        >>> index, _ = TaskSampler([4, 1]).sample(storage, batch_size=3)
        >>> index.shape, index[1].tolist()
        (torch.Size([2, 3]), [4, 4, 4])
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
        """Indices, and no information on them."""
        rows = batch_size if self.flat else len(self.sizes)
        shape = (rows,) if self.flat else (rows, batch_size)
        if self.flat and self._weights is None:
            return self._integers(len(storage), shape), {}
        if self._weights is None:
            number = torch.arange(rows, device=self._sizes.device)
        else:
            number = self._weights.multinomial(rows, replacement=True, generator=self._rng)
        number = number if self.flat else number.unsqueeze(-1)
        # From so wide a range the remainder is as good as uniform for every size.
        return self._starts[number] + self._integers(2**62, shape) % self._sizes[number], {}

    def _integers(self, high: int, shape: tuple[int, ...]) -> Tensor:
        return torch.randint(high, shape, generator=self._rng, device=self._sizes.device)

    def state_dict(self) -> dict[str, Any]:
        """Sizes and weights."""
        return {"sizes": self.sizes, "weights": self.weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes the weights over.

        Raises:
            BMRLError: for data sets of other sizes.
        """
        if state_dict["sizes"] != self.sizes:
            message = f"data sets of {state_dict['sizes']} transitions; valid: {self.sizes}"
            raise BMRLError(message)
        self._set_weights(state_dict["weights"])

    def dumps(self, path: str | Path) -> None:
        """Writes the state to a folder."""
        Path(path).mkdir(exist_ok=True)
        (Path(path) / "sampler_metadata.json").write_text(json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Reads what :meth:`dumps` wrote, as :meth:`load_state_dict` does."""
        self.load_state_dict(json.loads((Path(path) / "sampler_metadata.json").read_text()))

    def _empty(self) -> None:
        """Nothing to forget: the data sets stay."""


class HandsOutCopies(Storage):
    """Never hands out its own tensordict.

    All rows at once, ``buffer[:]``, are TorchRL's storages' own: a buffer's transforms write to
    them, and what was normalised is normalised again at the next call, and in all samples.
    """

    def get(self, index: Any) -> Any:
        """Rows of the data; tensors may be those of the storage."""
        data = super().get(index)
        return data.copy() if data is self._storage else data


class DeviceStorage(HandsOutCopies, LazyTensorStorage):
    """Data in the memory of a device."""


class MemmapStorage(HandsOutCopies, LazyMemmapStorage):
    """Takes rows by index_select, which copies them whole: twice as fast as indexing on the CPU."""

    def get(self, index: Any) -> Any:
        """Rows of the data."""
        integers = isinstance(index, Tensor) and index.dtype == torch.int64
        if not (integers and index.ndim and self._is_full and (index >= 0).all()):
            return super().get(index)

        def rows(column: Tensor) -> Tensor:
            return column.index_select(0, index.flatten()).unflatten(0, index.shape)

        return self._storage.apply(rows, batch_size=index.shape)


class DatasetBuffer(TensorDictReplayBuffer):
    """Keeps its data and draws without pickle; samples that were prepared ahead are left out."""

    def dumps(self, path: str | Path) -> None:
        """Writes data, sampler and the buffer's own generator, if it has one, to a folder."""
        path = Path(path).absolute()
        path.mkdir(parents=True, exist_ok=True)
        self.storage.dumps(path / "storage")
        self.sampler.dumps(path / "sampler")
        if self._rng is not None:
            state = TensorDict({"rng_state": self._rng.get_state().clone()}, [])
            state.memmap(path / "rng_state")

    def loads(self, path: str | Path) -> None:
        """Reads what :meth:`dumps` wrote, for data sets of the same sizes.

        Raises:
            DataError: if there is no such folder, or one of other data.
            BMRLError: for data sets of other sizes.
        """
        path = Path(path).absolute()
        try:
            self.sampler.loads(path / "sampler")  # before the storage is overwritten
            read_memmap(path / "storage")  # TorchRL's reader, next, would take pickles
            self.storage.loads(path / "storage")
            if self._rng is not None and (path / "rng_state").exists():
                self._rng.set_state(read_memmap(path / "rng_state")["rng_state"])
        except BMRLError:
            raise
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise DataError(path, None, f"not a dump of these data ({error})") from error

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes over what ``state_dict`` gave, for data sets of the same sizes."""
        self.sampler.load_state_dict(state_dict["_sampler"])
        super().load_state_dict({**state_dict, "_prefetch_state": None})
