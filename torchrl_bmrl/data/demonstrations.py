"""Demonstrations of a run folder as training data: checked, normalised transitions."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.data.convert import Stream
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.data.robomimic_file import CONTEXT_MASK, read_metadata
from torchrl_bmrl.data.sources import open_sources
from torchrl_bmrl.envs.transforms import (
    ObservationStatistics,
    make_observation_transform,
    observation_parts,
    transform_data,
)
from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.files import digest_of, read_json, write_atomic
from torchrl_bmrl.tasks import Task

TRANSITION_KEYS = (
    "observation",
    "action",
    "episode",
    "step",
    "task",
    *(("next", key) for key in ("observation", "reward", "done", "terminated", "truncated")),
)
"""Keys of the transitions that training reads."""


def demonstration_path(data_dir: Path, name: str) -> Path:
    """The file with the demonstrations of the task of a name."""
    return data_dir / f"{name}.hdf5"


def has_contexts(path: Path) -> bool:
    """Whether a file of demonstrations also has episodes of another behaviour.

    Args:
        path: a file in robomimic's layout.

    Raises:
        DataError: if it is missing or damaged.
    """
    return bool(read_metadata(path)["masks"].get(CONTEXT_MASK))


def read_demonstrations(
    path: Path, task: Task, *, split: str | None = None, index: int, sha256: str | None = None
) -> TensorDictBase:
    """Demonstrations of a task as they were recorded.

    Args:
        path: a file in robomimic's layout; it is converted once, beside the file.
        task: the task.
        split: ``"train"``, ``"valid"`` or ``None`` for all.
        index: class index y of the task.
        sha256: of the content that the file must have; ``None`` for any.

    Returns:
        batch ``[N]`` with the keys of
        :class:`~torchrl_bmrl.data.datasets.RobomimicExperienceReplay` and ``task``.

    Raises:
        DataError: naming file and key: for a file that this class refuses, for parts that do not
            make an observation, for missing ``successes`` if the task has a definition of success,
            for a recorded task whose episode terminates, since its horizon only truncates, and for
            other content.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data import Episode
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> from torchrl_bmrl.tasks import DemonstrationFiles
        >>> parts = {"arm": np.zeros((5, 7)), "door": np.zeros((5, 1))}
        >>> episode = Episode(
        ...     observations=parts,
        ...     next_observations=parts,
        ...     actions=np.zeros((5, 7)),
        ...     rewards=np.zeros(5),
        ...     terminated=np.zeros(5, bool),
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "door.hdf5"
        >>> write_episodes(path, [episode], env_args={}, masks={"train": [0]})
        >>> task = Task(name="door", files=DemonstrationFiles(path=str(path)))
        >>> read_demonstrations(path, task, split="train", index=1)["task"].tolist()
        [1, 1, 1, 1, 1]
    """
    replay = RobomimicExperienceReplay(path, split=split, observation_keys=task.parts)
    if sha256 is not None and replay.sha256 != sha256:
        raise _other_content(path, replay.sha256, sha256)
    data = replay[:].copy()
    try:
        transform = make_observation_transform(task, parts=observation_parts(task, data))
        transform(data[:1].exclude("next"))
    except Exception as error:  # CatTensors raises Exception itself
        raise DataError(
            path, "obs", f"does not make an observation of task {task.name} ({error})"
        ) from error
    if task.success is not None and data.get(("next", "success"), None) is None:
        message = "no successes; valid: successes (T,) in every demonstration, or a task without "
        raise DataError(path, "data", message + "the key success")
    if task.record is not None and data["next", "terminated"].any():
        raise DataError(path, "terminated", "an episode terminates; valid: none, horizons truncate")
    return data.set("task", torch.full((len(data),), index))


def phase_names(path: Path, demo: str, episode: Episode) -> tuple[str, ...]:
    """The names of an episode's phases; none for one without phases.

    Args:
        path: of its file, for messages.
        demo: its key, for messages.
        episode: with all attributes, and the extra ``phases`` if it has one.

    Raises:
        DataError: if the names are not a list, or an index has no name.
    """
    phases, names = episode.extras.get("phases"), episode.attributes.get("phase_names", ())
    if phases is None:
        return ()
    if not isinstance(names, list | tuple):
        message = f"attribute phase_names is {reprlib.repr(names)}; valid: a list of names"
        raise DataError(path, demo, message)
    if names and not np.isin(phases, np.arange(len(names))).all():
        raise DataError(
            path,
            f"{demo}/phases",
            f"holds {np.unique(phases).tolist()}; valid: 0 to {len(names) - 1}, the indices of "
            "phase_names",
        )
    return tuple(map(str, names))


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
            found = phase_names(path, f"data/{demo}", episode)
            names = found if names is None else names
            if found != names:
                raise DataError(
                    path, f"data/{demo}", f"phases are {found}; valid: {names}, as before"
                )
            parts.append(torch.as_tensor(phases).long())
    joined = torch.cat(parts)
    return (joined, names) if names else (torch.zeros_like(joined), ())


def write_statistics(data_dir: Path, tasks: Sequence[Task]) -> ObservationStatistics:
    """Computes the statistics of the training demonstrations and writes ``statistics.json``.

    ``loc`` and ``scale`` over all tasks together normalise observations; those of each task are
    stored under ``tasks``, with the SHA-256 of the task's file (:func:`check_demonstrations`).

    Args:
        data_dir: folder with ``<task>.hdf5``, each with a mask ``train``.
        tasks: the tasks, which have the same weight.

    Returns:
        the statistics over all tasks together.

    Raises:
        DataError: for files that :func:`read_demonstrations` refuses, and for tasks whose
            observations or actions differ in size or parts.

    Example:
        >>> import tempfile
        >>> try:
        ...     write_statistics(Path(tempfile.mkdtemp()), [])
        ... except DataError as error:
        ...     print(error.message)
        no tasks; valid: at least one
    """
    if not tasks:
        raise DataError(data_dir, None, "no tasks; valid: at least one")
    paths = [demonstration_path(data_dir, task.name) for task in tasks]
    digests = [digest_of(path) for path in paths]
    raw = [
        read_demonstrations(path, task, split="train", index=index, sha256=digest)
        for index, (path, task, digest) in enumerate(zip(paths, tasks, digests, strict=True))
    ]
    first = _layout(tasks[0], raw[0])
    for task, data in zip(tasks, raw, strict=True):
        if (layout := _layout(task, data)) != first:
            raise DataError(
                demonstration_path(data_dir, task.name),
                None,
                f"its transitions have {layout}; valid: {first}, as those of {tasks[0].name}",
            )
    statistics = ObservationStatistics.of(raw, tasks)
    each = {
        task.name: ObservationStatistics.of([data], [task]).to_lists()
        | {"transitions": len(data), "sha256": digest}
        for task, data, digest in zip(tasks, raw, digests, strict=True)
    }
    write_atomic(
        data_dir / "statistics.json", json.dumps(statistics.to_lists() | {"tasks": each}) + "\n"
    )
    return statistics


def check_demonstrations(data_dir: Path, tasks: Sequence[Task]) -> bool:
    """Checks that the demonstrations are those that ``statistics.json`` was computed from.

    Args:
        data_dir: folder with ``<task>.hdf5``. Missing files are not compared.
        tasks: the tasks.

    Returns:
        whether the file names all these tasks and the content of their files, as those of earlier
        versions do not.

    Raises:
        DataError: naming the first file of other content, or its damage.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.tasks import get_task
        >>> check_demonstrations(Path(tempfile.mkdtemp()), [get_task("reach")])
        False
    """
    known = _known_content(data_dir)
    for task in tasks:
        file = demonstration_path(data_dir, task.name)
        if task.name not in known or not file.is_file():
            continue
        if (digest := digest_of(file)) != known[task.name]:
            with open_sources(file) as sources:  # damage is named more exactly
                for _ in Stream(sources):
                    pass
            raise _other_content(file, digest, known[task.name])
    return list(known) == [task.name for task in tasks]


def _known_content(data_dir: Path) -> dict[str, str]:
    """SHA-256 of the tasks' files when their statistics were computed; none in earlier versions."""
    try:
        each = read_json(data_dir / "statistics.json", "the statistics of a data set")["tasks"]
        return {name: str(each[name]["sha256"]) for name in each if "sha256" in each[name]}
    except (DataError, KeyError, TypeError):  # reported when the statistics are read
        return {}


def _other_content(file: Path, now: str, before: str) -> DataError:
    return DataError(
        file,
        None,
        f"its content is {now[:12]} and was {before[:12]} (SHA-256) when statistics.json was "
        "written, which normalises the observations of this run; valid: the file as it was, or "
        "another run_dir",
    )


def _layout(task: Task, data: TensorDictBase) -> str:
    """Sizes of the observation's parts and of the action, for messages."""
    names = task.parts or observation_parts(task, data) or ()
    sizes = [f"{name} {tuple(data[name].shape[1:])}" for name in (*names, "action")]
    return ", ".join(sizes)


def read_statistics(data_dir: Path, task: Task | None = None) -> ObservationStatistics:
    """Reads the statistics that :func:`write_statistics` wrote.

    Args:
        data_dir: folder of the demonstrations.
        task: whose statistics; ``None`` for those over all tasks.

    Raises:
        DataError: if the file is missing or damaged, or does not contain the task.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_atomic(folder / "statistics.json", '{"loc": [0.5], "scale": [2.0]}')
        >>> read_statistics(folder).scale
        tensor([2.])
    """
    path = data_dir / "statistics.json"
    if not path.is_file():
        raise DataError(path, None, "no such file; recipes/collect.py writes it")
    content = read_json(path, "the statistics of a data set")
    name = None if task is None else task.name
    try:
        content = content if name is None else content["tasks"][name]
        return ObservationStatistics.from_lists(content)
    except (BMRLError, KeyError, TypeError) as error:
        raise DataError(path, name, f"not the statistics of a data set ({error})") from error


def load_transitions(
    data_dir: Path, task: Task, statistics: ObservationStatistics, *, split: str, index: int
) -> TensorDictBase:
    """A task's transitions, normalised.

    Args:
        data_dir: folder of the demonstrations.
        task: the task.
        statistics: of the normalisation.
        split: ``"train"`` or ``"valid"``.
        index: class index y of the task.

    Returns:
        batch ``[N]`` with ``observation (N, n)``, ``action``, ``episode``, ``step``, ``task`` and
        under ``"next"`` ``observation``, ``reward``, ``done``, ``terminated``, ``truncated``.

    Raises:
        DataError: for a file that :func:`read_demonstrations` refuses, and for other content than
            that of the statistics.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.data import Episode
        >>> from torchrl_bmrl.data.robomimic import write_episodes
        >>> from torchrl_bmrl.tasks import DemonstrationFiles
        >>> parts = {"arm": np.zeros((5, 7))}
        >>> episode = Episode(
        ...     observations=parts,
        ...     next_observations=parts,
        ...     actions=np.zeros((5, 2)),
        ...     rewards=np.zeros(5),
        ...     terminated=np.zeros(5, bool),
        ... )
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_episodes(folder / "door.hdf5", [episode], env_args={}, masks={"train": [0]})
        >>> task = Task(name="door", files=DemonstrationFiles(path="door.hdf5"))
        >>> statistics = write_statistics(folder, [task])
        >>> data = load_transitions(folder, task, statistics, split="train", index=0)
        >>> data["next", "observation"].shape
        torch.Size([5, 7])
    """
    path = demonstration_path(data_dir, task.name)
    known = _known_content(data_dir).get(task.name)
    data = read_demonstrations(path, task, split=split, index=index, sha256=known)
    # The same keys for every task: other arrays may differ from file to file.
    return transform_data(data, task, statistics).select(*TRANSITION_KEYS)
