"""Replay buffers over the data of one task, of several, or of a mixture of data sets.

The data are concatenated in one storage: a memory map, or the training device's memory if they fit.
A :class:`~torchrl_bmrl.data.sampler.TaskSampler` samples from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import isfinite
from numbers import Integral
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter

from torchrl_bmrl.data.sampler import (
    DatasetBuffer,
    Device,
    DeviceStorage,
    MemmapStorage,
    TaskSampler,
)
from torchrl_bmrl.errors import BMRLError, ConfigError

EPISODE_NUMBERS = tuple(
    key for own in (("episode",), ("collector", "traj_ids")) for key in (own, ("previous", *own))
)
"""Keys of the numbers of episodes."""
PREFETCH = 2
"""Default number of prefetched samples if every sample is transferred to the device."""
PART = 65536
"""Transitions that are checked at once."""


def with_previous(data: TensorDictBase, keys: Sequence[Any]) -> TensorDictBase:
    """Adds to each transition the one before it in its episode, under ``"previous"``.

    The first transition of an episode is its own predecessor, and so is a transition whose
    predecessor is not in the data.

    Args:
        data: batch ``[N]`` in the order of the episodes, with ``step``. If it also has
            ``episode``, transitions of two episodes are never joined.
        keys: the keys of a transition to copy.

    Example:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"step": torch.tensor([0, 1, 0]), "x": torch.arange(3)}, [3])
        >>> with_previous(data, ["x"])["previous", "x"]
        tensor([0, 0, 2])
    """
    step, episode = data.get("step"), data.get("episode", None)
    follows = torch.zeros_like(step, dtype=torch.bool)
    follows[1:] = step[1:] == step[:-1] + 1
    if episode is not None:
        follows[1:] &= episode[1:] == episode[:-1]
    index = torch.arange(len(data), device=step.device) - follows.long()
    return data.copy().set("previous", data.select(*keys)[index])


def make_replay_buffer(
    data: TensorDictBase,
    *,
    batch_size: int,
    device: Device = None,
    prefetch: int | None = None,
    scratch_dir: str | None = None,
) -> TensorDictReplayBuffer:
    """Makes a buffer that samples single transitions with replacement.

    Args:
        data: batch ``[N]``; copied once.
        batch_size: number of transitions in a sample.
        device: of the samples, see :func:`make_multi_task_replay_buffer`.
        prefetch: number of prefetched samples, see there.
        scratch_dir: folder of the memory map; a temporary one by default.

    Returns:
        a buffer of samples ``[batch_size]`` with the keys of the data and ``index``.

    Raises:
        BMRLError: without data, or for numbers that are not finite. The losses check this only on
            the CPU, because elsewhere the check would wait for the device.
        ConfigError: for invalid options.

    Example:
        >>> from tensordict import TensorDict
        >>> buffer = make_replay_buffer(TensorDict({"x": torch.arange(10)}, [10]), batch_size=4)
        >>> buffer.sample().batch_size
        torch.Size([4])
    """
    _check_data(data, "the data")
    return _make_buffer([data], None, True, batch_size, device, prefetch, scratch_dir)


def make_multi_task_replay_buffer(
    datasets: Sequence[TensorDictBase],
    *,
    batch_size: int,
    weights: Sequence[float] | None = None,
    device: Device = None,
    prefetch: int | None = None,
    scratch_dir: str | None = None,
) -> TensorDictReplayBuffer:
    """Makes a buffer whose samples have one row of ``batch_size`` transitions per task.

    If ``device`` is a GPU, the data lie in its memory if they take at most half of the free memory.
    Otherwise they are memory-mapped, and threads prefetch samples and transfer them from pinned
    memory.

    Sampling follows ``torch.manual_seed``. With ``prefetch`` it uses the buffer's own generator,
    which torch's seeds when the buffer is made, because the threads' timing varies. Equal seeds
    then still give equal samples with ``prefetch=1``; more threads may return them in another
    order.

    Args:
        datasets: one batch ``[N_i]`` per task, in the order of the tasks, with equal keys, shapes
            and dtypes. They are copied once, and their episodes renumbered
            (:func:`number_episodes`).
        batch_size: number of transitions in a row.
        weights: ``None`` for row i from task i. With one positive number per task, each row comes
            from a task drawn in proportion to them, with replacement: a sample may have two rows
            of one task and none of another, and ``task`` in the data tells them apart.
        device: of the samples; the CPU by default.
        prefetch: number of prefetched samples and of threads; by default 2 if samples are
            transferred, else 0.
        scratch_dir: folder of the memory map; a temporary one by default.

    Returns:
        a buffer of samples ``[num_tasks, batch_size]`` with the keys of the data and ``index``. Its
        ``loads`` reads what its ``dumps`` wrote, for data sets of the same sizes.

    Raises:
        BMRLError: without data sets, and for a data set that is empty, differs from the first in a
            key, shape or dtype, or has a number that is not finite.
        ConfigError: for invalid options.

    Example:
        >>> from tensordict import TensorDict
        >>> tasks = [TensorDict({"task": torch.full((10,), i)}, [10]) for i in range(3)]
        >>> make_multi_task_replay_buffer(tasks, batch_size=2).sample()["task"].tolist()
        [[0, 0], [1, 1], [2, 2]]
    """
    datasets = _check_datasets(datasets)
    if weights is not None:
        weights = _check_weights(weights, len(datasets), zero=False)
    return _make_buffer(datasets, weights, False, batch_size, device, prefetch, scratch_dir)


def make_mixed_replay_buffer(
    datasets: Sequence[TensorDictBase],
    *,
    weights: Sequence[float],
    batch_size: int,
    device: Device = None,
    prefetch: int | None = None,
    scratch_dir: str | None = None,
) -> TensorDictReplayBuffer:
    """Makes a buffer over a mixture, such as scripted and human demonstrations of one task.

    Args:
        datasets: batches ``[N_i]`` with equal keys, shapes and dtypes. They are copied once, and
            their episodes renumbered (:func:`number_episodes`).
        weights: one number per data set, none negative. A transition comes from data set i with
            probability ``weights[i] / sum(weights)``, whatever the sizes.
        batch_size: number of transitions in a sample.
        device: of the samples, see :func:`make_multi_task_replay_buffer`.
        prefetch: number of prefetched samples, see there.
        scratch_dir: folder of the memory map; a temporary one by default.

    Returns:
        a buffer of samples ``[batch_size]`` with the keys of the data and ``index``.

    Raises:
        BMRLError: for the data sets that :func:`make_multi_task_replay_buffer` refuses.
        ConfigError: for invalid options.

    Example:
        >>> from tensordict import TensorDict
        >>> few, many = (TensorDict({"x": torch.full((n,), n)}, [n]) for n in (1, 1000))
        >>> buffer = make_mixed_replay_buffer([few, many], weights=[1, 0], batch_size=3)
        >>> buffer.sample()["x"].tolist()
        [1, 1, 1]
    """
    datasets = _check_datasets(datasets)
    weights = _check_weights(weights, len(datasets), zero=True)
    return _make_buffer(datasets, weights, True, batch_size, device, prefetch, scratch_dir)


def number_episodes(datasets: Sequence[TensorDictBase]) -> list[TensorDictBase]:
    """Renumbers the episodes of several data sets so that no two have the same number.

    The episodes of every file are numbered from 0. Here, each data set continues after the one
    before it, unless its numbers are larger already.

    Args:
        datasets: batches ``[N_i]``, which are not changed.

    Returns:
        the same data with other ``episode`` and ``("collector", "traj_ids")``, also under
        ``"previous"``, if they are integers.

    Raises:
        BMRLError: if a number exceeds its dtype.

    Example:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"episode": torch.tensor([0, 0, 1])}, [3])
        >>> [part["episode"].tolist() for part in number_episodes([data, data])]
        [[0, 0, 1], [2, 2, 3]]
    """
    numbered, free = [], 0
    for number, data in enumerate(datasets):
        keys = [key for key in EPISODE_NUMBERS if _is_whole(data.get(key, None))]
        if keys and len(data):
            low = min(int(data.get(key).min()) for key in keys)
            high = max(int(data.get(key).max()) for key in keys)
            shift = max(free - low, 0) if number else 0
            free = max(free, high + shift + 1)
            for key in keys if shift else ():
                value = data.get(key)
                if high + shift > torch.iinfo(value.dtype).max:
                    raise BMRLError(
                        f"data set {number}: {key!r} is {value.dtype}; valid: a dtype up to "
                        f"{high + shift}, because all data sets' episodes are numbered together"
                    )
                data = data.copy().set(key, value + shift)
        numbered.append(data)
    return numbered


def _is_whole(value: Any) -> bool:
    kinds = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
    return isinstance(value, torch.Tensor) and value.dtype in kinds


def fits(datasets: Sequence[TensorDictBase], device: torch.device) -> bool:
    """Whether data take at most half of a CUDA device's free memory; ``False`` elsewhere."""
    if device.type != "cuda":
        return False
    return sum(data.bytes() for data in datasets) <= torch.cuda.mem_get_info(device)[0] / 2


def _make_buffer(
    datasets: Sequence[TensorDictBase],
    weights: Sequence[float] | None,
    flat: bool,
    batch_size: int,
    device: Device,
    prefetch: int | None,
    scratch_dir: str | None,
) -> TensorDictReplayBuffer:
    target = check_device(device)
    sizes = [len(data) for data in datasets]
    if target.type != "cpu" and fits(datasets, target):
        storage = DeviceStorage(sum(sizes), device=target)
    else:
        storage = MemmapStorage(sum(sizes), scratch_dir=scratch_dir)
    transferred = storage.device != target
    prefetch = PREFETCH * transferred if prefetch is None else prefetch
    _check_count("batch_size", batch_size, 1)
    _check_count("prefetch", prefetch, 0)
    end = 0
    try:
        for data in number_episodes(datasets):
            start, end = end, end + len(data)
            storage.set(slice(start, end), data)
    except (OSError, RuntimeError) as error:
        where = scratch_dir or "the temporary folder"
        raise BMRLError(f"the data cannot be stored in {where} ({error})") from error
    if isinstance(storage, MemmapStorage):
        storage.expect_random_reads()
    return DatasetBuffer(
        storage=storage,
        sampler=TaskSampler(sizes, weights=weights, flat=flat, device=storage.device),
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
        transform=partial(_transfer, device=target) if transferred else None,
        prefetch=prefetch,
        generator=_own_generator(storage.device) if prefetch else None,
    )


def _transfer(data: TensorDictBase, device: torch.device) -> TensorDictBase:
    if device.type != "cuda":
        return data.to(device)
    return data.pin_memory(num_threads=0).to(device, non_blocking=True)


def _own_generator(device: torch.device) -> torch.Generator:
    seed = torch.randint(2**62, ()).item()
    return torch.Generator(device=device).manual_seed(int(seed))


def _check_count(name: str, value: Any, least: int) -> None:
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ConfigError(f"{name} is {value!r}; valid: at least {least}, an integer")


def check_device(device: Device) -> torch.device:
    """Returns a device that torch can use here.

    Raises:
        ConfigError: for any other.
    """
    try:
        return torch.empty(0, device="cpu" if device is None else device).device
    except (AssertionError, RuntimeError, TypeError) as error:
        raise ConfigError(
            f"device is {device!r}; valid: one that torch can use ({error})"
        ) from error


def _check_weights(weights: Sequence[float], count: int, *, zero: bool) -> list[float]:
    try:
        values = [float(weight) for weight in weights]
    except (TypeError, ValueError):
        values = []
    in_range = all(isfinite(x) and (x >= 0 if zero else x > 0) for x in values)
    if len(values) != count or not in_range or not any(values):
        kind = "none negative, one positive" if zero else "all positive"
        message = f"weights is {weights}; valid: {count} finite numbers, one per data set, {kind}"
        raise ConfigError(message)
    return [value / max(values) for value in values]


def _check_datasets(datasets: Sequence[TensorDictBase]) -> list[TensorDictBase]:
    datasets = list(datasets)
    if not datasets:
        raise BMRLError("no data sets; valid: at least one")
    if wrong := [data for data in datasets if not isinstance(data, TensorDictBase)]:
        raise BMRLError(f"a data set is a {type(wrong[0]).__name__}; valid: TensorDicts")
    for number, data in enumerate(datasets):
        _check_data(data, f"data set {number}")
        given, expected = _layout(data), _layout(datasets[0])
        for key in [*expected, *given]:
            if given.get(key) != expected.get(key):
                raise BMRLError(
                    f"data set {number}: {key!r} is {given.get(key, 'missing')}, in data set 0 "
                    f"{expected.get(key, 'missing')}; valid: equal keys, shapes and dtypes"
                )
    return datasets


def _check_data(data: TensorDictBase, name: str) -> None:
    if data.batch_dims != 1 or not len(data):
        size = list(data.batch_size)
        raise BMRLError(f"{name}: batch size {size}; valid: [N] with at least one transition")
    for key, value in data.items(include_nested=True, leaves_only=True):
        # In parts: the data may be larger than memory, and a check of all copies them.
        for start, part in enumerate(value.split(PART)) if value.is_floating_point() else ():
            if not part.isfinite().all():
                row = PART * start + int((~part.isfinite()).nonzero()[0, 0])
                message = f"{key!r} is not finite in transition {row}; valid: finite numbers"
                raise BMRLError(f"{name}: {message}")


def _layout(data: TensorDictBase) -> dict[Any, str]:
    """Dtype and shape of a transition by key."""
    items = data.items(include_nested=True, leaves_only=True)
    return {key: f"{value.dtype} {tuple(value.shape[1:])}" for key, value in items}
