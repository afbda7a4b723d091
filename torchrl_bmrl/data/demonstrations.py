"""From the demonstrations of a run folder to what trains: checked, normalised transitions."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.data.schema import ACTION_DIM, OBSERVATION_SHAPES
from torchrl_bmrl.envs.transforms import ObservationStatistics, transform_data
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.files import read_json, write_atomic
from torchrl_bmrl.names import TASKS, check_task


def demonstration_path(data_dir: Path, task: str) -> Path:
    """The file of a task's demonstrations."""
    return data_dir / f"{check_task(task)}.hdf5"


def read_demonstrations(path: Path, *, split: str | None = None, num_task: int) -> TensorDictBase:
    """Demonstrations of one of the six tasks as they were recorded.

    Args:
        path: a file in robomimic's layout; converted once, beside it.
        split: ``"train"``, ``"valid"`` or ``None`` for all.
        num_task: class index y.

    Returns:
        batch ``[N]`` with the keys of
        :class:`~torchrl_bmrl.data.datasets.RobomimicExperienceReplay` and ``task``.

    Raises:
        DataError: naming file and key, for what that class refuses, and for parts of the
            observation or actions that are not the six tasks', missing ``successes``, or an episode
            that terminates: these tasks end at their horizon, which truncates.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data import Episode
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> parts = {name: np.zeros((5, size)) for name, size in OBSERVATION_SHAPES.items()}
        >>> episode = Episode(
        ...     observations=parts,
        ...     next_observations=parts,
        ...     actions=np.zeros((5, 7)),
        ...     rewards=np.zeros(5),
        ...     terminated=np.zeros(5, bool),
        ...     extras={"successes": np.zeros(5, bool)},
        ... )
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_episodes(folder / "lift.hdf5", [episode], env_args={}, masks={"train": [0]})
        >>> data = read_demonstrations(folder / "lift.hdf5", split="train", num_task=1)
        >>> data["robot0_eef_pos"].shape, data["task"].tolist()
        (torch.Size([5, 3]), [1, 1, 1, 1, 1])
    """
    replay = RobomimicExperienceReplay(path, split=split, observation_keys=OBSERVATION_SHAPES)
    data = replay[:].copy()
    for key, size in {**OBSERVATION_SHAPES, "action": ACTION_DIM}.items():
        if data[key].shape[1:] != (size,):
            raise DataError(path, key, f"shape {tuple(data[key].shape)}; valid: (N, {size})")
    if data.get(("next", "success"), None) is None:
        raise DataError(path, "data", "no successes; valid: successes (T,) in every demonstration")
    if data["next", "terminated"].any():
        raise DataError(path, "terminated", "an episode terminates; valid: none, horizons truncate")
    return data.set("task", torch.full((len(data),), num_task))


def read_phases(path: Path, *, split: str) -> tuple[Tensor, tuple[str, ...]]:
    """The expert's phase at each step of the demonstrations.

    Args:
        path: a file in robomimic's layout.
        split: ``"train"`` or ``"valid"``.

    Returns:
        indices ``(N,)``, in the order of :func:`read_demonstrations`, and the phases' names. Files
        of other demonstrators have no phases: zeros ``(N,)`` and no names.

    Raises:
        DataError: naming file and key, if some demonstrations have phases and others do not, they
            differ in the names, or an index has no name.
    """
    parts, names = [], None
    with open_episodes(path, split=split, observation_keys=[], extras=["phases"]) as episodes:
        for demo, episode in episodes.items():
            phases = np.asarray(episode.extras.get("phases", np.zeros(len(episode))))
            found = tuple(map(str, episode.attributes.get("phase_names", ())))
            found = found if "phases" in episode.extras else ()
            names = found if names is None else names
            if found != names:
                raise DataError(
                    path, f"data/{demo}", f"phases are {found}; valid: {names}, as before"
                )
            if names and not np.isin(phases, np.arange(len(names))).all():
                raise DataError(
                    path,
                    f"data/{demo}/phases",
                    f"holds {np.unique(phases).tolist()}; valid: 0 to {len(names) - 1}, the "
                    "positions in phase_names",
                )
            parts.append(torch.as_tensor(phases).long())
    joined = torch.cat(parts)
    return (joined, names) if names else (torch.zeros_like(joined), ())


def write_statistics(data_dir: Path, tasks: Iterable[str]) -> ObservationStatistics:
    """Statistics of the training demonstrations, kept in ``statistics.json``.

    Those over all tasks together (``loc`` and ``scale``) normalise; those of each task are under
    ``tasks``.

    Args:
        data_dir: folder of the demonstrations, ``<task>.hdf5``, each with a mask ``train``; the
            statistics are written into it.
        tasks: names of the tasks, each with the same weight.

    Returns:
        those over all tasks together.

    Raises:
        UnknownNameError: for a name that is not a task.
        DataError: for files that :func:`read_demonstrations` refuses.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data import Episode
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> parts = {name: np.zeros((5, size)) for name, size in OBSERVATION_SHAPES.items()}
        >>> episode = Episode(
        ...     observations=parts,
        ...     next_observations=parts,
        ...     actions=np.zeros((5, 7)),
        ...     rewards=np.zeros(5),
        ...     terminated=np.zeros(5, bool),
        ...     extras={"successes": np.zeros(5, bool)},
        ... )
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_episodes(folder / "lift.hdf5", [episode], env_args={}, masks={"train": [0]})
        >>> write_statistics(folder, ["lift"]).loc.shape
        torch.Size([33])
    """
    raw = {
        task: read_demonstrations(
            demonstration_path(data_dir, task), split="train", num_task=TASKS.index(task)
        )
        for task in tasks
    }
    statistics = ObservationStatistics.of(list(raw.values()))
    content = _plain(statistics) | {
        "tasks": {
            task: _plain(ObservationStatistics.of([data])) | {"transitions": len(data)}
            for task, data in raw.items()
        }
    }
    write_atomic(data_dir / "statistics.json", json.dumps(content) + "\n")
    return statistics


def _plain(statistics: ObservationStatistics) -> dict[str, object]:
    return {"loc": statistics.loc.tolist(), "scale": statistics.scale.tolist()}


def read_statistics(data_dir: Path, task: str | None = None) -> ObservationStatistics:
    """Reads what :func:`write_statistics` wrote.

    Args:
        data_dir: folder of the demonstrations.
        task: whose statistics; ``None`` for those over all tasks.

    Raises:
        DataError: if the file is missing or damaged, or knows nothing of the task.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_atomic(folder / "statistics.json", '{"loc": [0.5], "scale": [2.0]}')
        >>> read_statistics(folder)
        ObservationStatistics(loc=tensor([0.5000]), scale=tensor([2.]))
    """
    path = data_dir / "statistics.json"
    if not path.is_file():
        raise DataError(path, None, "no such file; recipes/collect.py writes it")
    content = read_json(path, "the statistics of a data set")
    try:
        if task is not None:
            content = content["tasks"][task]
        loc, scale = (torch.tensor(content[name], dtype=torch.float) for name in ("loc", "scale"))
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise DataError(path, task, f"not the statistics of a data set ({error})") from error
    finite = torch.cat([loc.reshape(-1), scale.reshape(-1)]).isfinite().all()
    if loc.shape != scale.shape or loc.ndim != 1 or not finite or not (scale > 0).all():
        raise DataError(path, "scale", "valid: as many positive numbers as in loc, all finite")
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
        batch ``[N]`` with ``observation (N, 33)`` in place of its parts, now and under ``"next"``,
        and the other keys of :func:`read_demonstrations`.

    Raises:
        UnknownNameError: for a name that is not a task.
        DataError: for a file that :func:`read_demonstrations` refuses.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data import Episode
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> parts = {name: np.zeros((5, size)) for name, size in OBSERVATION_SHAPES.items()}
        >>> episode = Episode(
        ...     observations=parts,
        ...     next_observations=parts,
        ...     actions=np.zeros((5, 7)),
        ...     rewards=np.zeros(5),
        ...     terminated=np.zeros(5, bool),
        ...     extras={"successes": np.zeros(5, bool)},
        ... )
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_episodes(folder / "lift.hdf5", [episode], env_args={}, masks={"train": [0]})
        >>> statistics = ObservationStatistics(torch.zeros(33), torch.ones(33))
        >>> data = load_transitions(folder, "lift", statistics, split="train", num_task=1)
        >>> data["next", "observation"].shape
        torch.Size([5, 33])
    """
    raw = read_demonstrations(demonstration_path(data_dir, task), split=split, num_task=num_task)
    return transform_data(raw, statistics)
