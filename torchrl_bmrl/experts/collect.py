"""Records episodes of scripted experts, one file for each episode until a task is complete."""

from __future__ import annotations

import inspect
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import (
    count_episodes,
    keep_episode,
    read_kept_episode,
    read_metadata,
    write_episodes,
)
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.experts.settings import Experts, ExpertSettings, experts_of
from torchrl_bmrl.run.locks import check_no_linked_folders, lock
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.tasks import Task, get_task


@dataclass(frozen=True, kw_only=True)
class _EpisodeJob:
    """One episode to record into a file."""

    task: Task
    seed: int
    path: Path
    expert: ExpertSettings
    after: tuple[Task, ...]
    like: tuple[Task, ...]


def _collect_job(job: _EpisodeJob, report: Report) -> None:
    assert job.task.record is not None
    episode = job.task.record(
        job.seed,
        noise=job.expert.noise,
        gains=job.expert.gains,
        after=job.after,
        **({"like": job.like} if job.like else {}),
        **job.task.options,
    )
    keep_episode(job.path, episode)
    report(1)


def collect_demonstrations(
    directory: Path,
    tasks: Sequence[Task],
    episodes: Mapping[str, int],
    *,
    valid_episodes: int,
    context_episodes: int = 0,
    noise: float,
    seed: int,
    workers: int,
    gains: Any = None,
    after: Mapping[str, Sequence[str]] | None = None,
    experts: Experts | None = None,
) -> dict[str, Path]:
    """Records demonstrations, one file in robomimic's layout per task.

    Finished episodes are saved under ``directory/.episodes``, so that after an interruption the
    same call records only the missing ones. A task's file is written after its last episode.

    Args:
        directory: folder of the files ``<task>.hdf5``.
        tasks: tasks with ``record``, recorded in this order.
        episodes: number of training episodes by task name.
        valid_episodes: number of held-out episodes of each task, under ``mask/valid``.
        context_episodes: number of episodes of each task in which the experts of some other tasks
            act in turn, under ``mask/context``; no agent is trained to act as in these.
        noise: standard deviation of the Gaussian action noise.
        seed: the seed; it decides every episode.
        workers: number of processes.
        gains: gains of the experts; ``None`` for the defaults.
        after: by task, a list of starts: names of tasks whose experts act first, joined by ``-``,
            or ``""``; the task's episodes use the entries in turn.
        experts: by task, or ``"default"``, a list of changes to ``noise`` and ``gains``
            (:func:`~torchrl_bmrl.experts.settings.experts_of`); the task's episodes use the entries
            in turn. The file contains the list in the attribute ``experts`` of ``data``. If it has
            several entries, each demonstration has the index of its entry in the attribute
            ``expert``, and the masks ``expert_<i>``, ``expert_<i>_train`` and ``expert_<i>_valid``
            select the demonstrations of one entry.

    Returns:
        the file of each task.

    Raises:
        ConfigError: for a task without ``record``, or with one that takes no ``like`` if there are
            ``context_episodes``, and for invalid ``experts``.
        UnknownNameError: for a name in ``after`` that is not a task.
        DataError: if an existing file has another number of episodes or another seed, or a folder
            in ``directory`` is a link.
        FolderInUseError: if another process records some of the tasks.
        StoppedError: if the run is stopped; finished episodes are saved.

    Example:
        >>> import tempfile
        >>> files = collect_demonstrations(
        ...     Path(tempfile.mkdtemp()),
        ...     [get_task("reach")],
        ...     {"reach": 1},
        ...     valid_episodes=1,
        ...     noise=0.2,
        ...     seed=0,
        ...     workers=1,
        ... )
        >>> files["reach"].name, count_episodes(files["reach"])
        ('reach.hdf5', 2)
    """
    by_name = {task.name: task for task in tasks}
    for task in tasks:
        if task.record is None:
            raise ConfigError(f"task {task.name} has no expert; valid: a task with record")
    befores = {
        name: [_parse_after(entry, by_name) for entry in (after or {}).get(name, ())] or [()]
        for name in by_name
    }
    changes = experts or {}
    chosen = {name: experts_of(name, changes, noise=noise, gains=gains) for name in by_name}
    files = {name: directory / f"{name}.hdf5" for name in by_name}
    if context_episodes and len(tasks) < 2:
        raise ConfigError("context_episodes with one task; valid: at least two tasks, or 0")
    for task in tasks if context_episodes else ():
        assert task.record is not None
        if "like" not in inspect.signature(task.record).parameters:
            raise ConfigError(
                f"task {task.name} has a record without like, and context_episodes is "
                f"{context_episodes}; valid: 0, or a record in which experts of other tasks can act"
            )
    own = {name: episodes[name] + valid_episodes for name in by_name}
    counts = {name: number + context_episodes for name, number in own.items()}
    check_no_linked_folders(directory)
    missing = [name for name, path in files.items() if not path.exists()]
    with ExitStack() as held:
        if missing:
            held.enter_context(lock(directory / ".episodes", missing))
        parts = {
            name: [directory / ".episodes" / name / f"{i:05d}.npz" for i in range(counts[name])]
            for name in missing
            if not files[name].exists()  # another process may have written it until now
        }
        jobs = [
            _EpisodeJob(
                task=by_name[name],
                seed=derive_seed(seed, "collect", name, i),
                path=path,
                expert=chosen[name][i % len(chosen[name])],
                after=befores[name][i % len(befores[name])],
                like=()
                if i < own[name]
                else others_than(tasks, name, seed=derive_seed(seed, name, i)),
            )
            for name, paths in parts.items()
            for i, path in enumerate(paths)
            if not path.exists()
        ]
        # Jobs with equal scenes follow each other, since a worker reuses its last scene.
        order = list(by_name)
        jobs.sort(key=lambda job: (order.index(job.task.name), [task.name for task in job.after]))
        run_jobs(
            _collect_job,
            jobs,
            workers=workers,
            total=len(jobs),
            description="collecting demonstrations",
            unit="episode",
            preload=[task.simulator for task in tasks if task.simulator],
        )
        for name, paths in parts.items():
            first, count = read_kept_episode(paths[0]), len(chosen[name])
            masks = {
                "train": range(episodes[name]),
                "valid": range(episodes[name], own[name]),
                **({"context": range(own[name], counts[name])} if context_episodes else {}),
            }
            write_episodes(
                files[name],
                (
                    _prepare(read_kept_episode(path), None if count == 1 else i % count)
                    for i, path in enumerate(paths)
                ),
                masks={**masks, **({} if count == 1 else _expert_masks(masks, count))},
                env_args=first.attributes.get("env_args", {}),
                attributes={
                    "task": name,
                    "action_noise": chosen[name][0].noise if count == 1 else noise,
                    "seed": seed,
                    **_entries(changes.get(name, changes.get("default"))),
                },
            )
            # The whole folder: a killed process may have left temporary files in it.
            shutil.rmtree(directory / ".episodes" / name)
    for name, path in files.items():
        if count_episodes(path) != counts[name]:
            raise DataError(
                path,
                "data",
                f"contains {count_episodes(path)} episodes; valid: {counts[name]}; choose another "
                "run_dir or remove the file",
            )
        recorded = read_metadata(path).get("seed", seed)
        if recorded != seed:
            message = f"recorded with seed {recorded}; valid: {seed}, or another folder"
            raise DataError(path, "data", message)
    return files


MAX_ATTEMPTS = 100
"""Starts that are tried until an expert succeeds."""


def record_success(
    task: Task, expert: ExpertSettings, seed_of: Callable[[int], int], **options: Any
) -> Episode:
    """Records an episode in which the task's expert succeeds.

    Args:
        task: with ``record``.
        expert: noise and gains.
        seed_of: returns the seed of each attempt.
        **options: further options of ``record``.

    Returns:
        the first episode that succeeds, or that does not tell success.

    Raises:
        BMRLError: if the expert fails from 100 starts.

    Example:
        >>> episode = record_success(get_task("reach"), ExpertSettings(noise=0.2), lambda i: i)
        >>> bool(episode.extras["successes"].any())
        True
    """
    assert task.record is not None
    for attempt in range(MAX_ATTEMPTS):
        episode = task.record(
            seed_of(attempt), noise=expert.noise, gains=expert.gains, **options, **task.options
        )
        successes = episode.extras.get("successes")
        if successes is None or successes.any():
            return episode
    raise BMRLError(f"the expert of {task.name} failed from {MAX_ATTEMPTS} starts")


WANDERING = 6
"""Experts that act in turn in an episode of another behaviour."""


def others_than(tasks: Sequence[Task], name: str, *, seed: int) -> tuple[Task, ...]:
    """Returns some of the other tasks at random, at most :data:`WANDERING`.

    Args:
        tasks: the tasks.
        name: the task to leave out; it may be none of them.
        seed: of the choice.

    Example:
        >>> tasks = [get_task(name) for name in ("reach", "lift", "push_up")]
        >>> sorted(task.name for task in others_than(tasks, "lift", seed=0))
        ['push_up', 'reach']
    """
    others = [task for task in tasks if task.name != name]
    order = np.random.default_rng(seed).permutation(len(others))[:WANDERING]
    return tuple(others[i] for i in order)


def _parse_after(entry: str, by_name: Mapping[str, Task]) -> tuple[Task, ...]:
    names = entry.split("-") if entry else []
    return tuple(by_name[name] if name in by_name else get_task(name) for name in names)


def _prepare(episode: Episode, expert: int | None) -> Episode:
    """Drops the attribute that is stored once for the whole file, and adds the expert's index."""
    attributes = {key: value for key, value in episode.attributes.items() if key != "env_args"}
    return replace(episode, attributes=attributes | ({} if expert is None else {"expert": expert}))


def _entries(entries: Sequence[Mapping[str, float]] | None) -> dict[str, str]:
    """Returns the file's attribute for a task's experts; empty if the setting has no entries."""
    return {} if entries is None else {"experts": json.dumps([dict(entry) for entry in entries])}


def _expert_masks(masks: Mapping[str, range], count: int) -> dict[str, list[int]]:
    """Returns the masks of each of ``count`` experts, without empty ones."""
    every = {"": range(sum(map(len, masks.values())))}
    every |= {f"_{mask}": positions for mask, positions in masks.items()}
    found = {
        f"expert_{expert}{mask}": [i for i in positions if i % count == expert]
        for expert in range(count)
        for mask, positions in every.items()
    }
    return {name: positions for name, positions in found.items() if positions}
