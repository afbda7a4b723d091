"""From demonstration files to what trains: checked, normalised transitions."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_bmrl.data.replay import stack_episodes
from torchrl_bmrl.data.robomimic import read_demonstrations
from torchrl_bmrl.envs.transforms import ObservationStatistics, transform_data
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.names import TASKS, check_task


def demonstration_path(data_dir: Path, task: str) -> Path:
    """The file of a task's demonstrations."""
    return data_dir / f"{check_task(task)}.hdf5"


def write_statistics(data_dir: Path, tasks: Iterable[str]) -> ObservationStatistics:
    """Statistics over the training demonstrations of all tasks, kept in ``statistics.json``."""
    raw = [
        stack_episodes(
            read_demonstrations(demonstration_path(data_dir, task), split="train"),
            task=TASKS.index(task),
        )
        for task in tasks
    ]
    statistics = ObservationStatistics.of(raw)
    text = json.dumps({"loc": statistics.loc.tolist(), "scale": statistics.scale.tolist()})
    write_atomic(data_dir / "statistics.json", text + "\n")
    return statistics


def read_statistics(data_dir: Path) -> ObservationStatistics:
    """Reads what :func:`write_statistics` wrote.

    Raises:
        DataError: if the file is missing or damaged.
    """
    path = data_dir / "statistics.json"
    if not path.is_file():
        raise DataError(path, None, "no such file; recipes/collect.py writes it")
    try:
        content = json.loads(path.read_text())
        loc, scale = torch.tensor(content["loc"]), torch.tensor(content["scale"])
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(path, None, f"not the statistics of a data set ({error})") from error
    if loc.shape != scale.shape or loc.ndim != 1 or not (scale > 0).all():
        raise DataError(path, "scale", "valid: as many positive numbers as in loc")
    return ObservationStatistics(loc, scale)


def load_transitions(
    data_dir: Path, task: str, statistics: ObservationStatistics, *, split: str, num_task: int
) -> TensorDictBase:
    """A task's transitions, normalised.

    Args:
        data_dir: folder of the demonstrations.
        task: its name.
        statistics: of the normalisation.
        split: ``"train"`` or ``"valid"``.
        num_task: class index y.

    Returns:
        batch ``[N]`` with ``observation (33,)`` and the keys of
        :func:`~torchrl_bmrl.data.stack_episodes`.
    """
    episodes = read_demonstrations(demonstration_path(data_dir, task), split=split)
    return transform_data(stack_episodes(episodes, task=num_task), statistics)
