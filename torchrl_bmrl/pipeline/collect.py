"""Demonstrations of every task: recorded with scripted experts, or imported from files."""

from __future__ import annotations

from torchrl_bmrl.data.demonstrations import (
    check_demonstrations,
    demonstration_path,
    read_statistics,
    write_statistics,
)
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.importing import (
    find_action_bounds,
    import_demonstrations,
    read_original_bounds,
    read_scaled_episode,
)
from torchrl_bmrl.data.options import Bounds, ReadOptions
from torchrl_bmrl.data.robomimic_file import CONTEXT_MASK
from torchrl_bmrl.data.sources import join_bounds
from torchrl_bmrl.envs.gym import action_bounds
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.run.progress import progress
from torchrl_bmrl.run.stops import check_stop
from torchrl_bmrl.tasks import Task

READ_NONE = "distill.context=set distill.inference_updates=0 distill.reward_updates=0"
"""Settings of a stage 2 that reads no episodes of another behaviour."""


def collect(run: Run) -> None:
    """Writes ``data/<task>.hdf5`` for every task, and ``data/statistics.json``.

    Tasks with a scripted expert are recorded. The files of the other tasks are imported: actions
    are scaled to [-1, 1] from the bounds of the environment, or from the common bounds of all
    files, and some episodes are held out. Existing files are not written again.

    Args:
        run: an open run.

    Raises:
        BMRLError: for demonstrations that cannot be recorded or trained on.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.pipeline import CollectSettings, Settings
        >>> settings = Settings(
        ...     run_dir=tempfile.mkdtemp(),
        ...     tasks={"reach": {"task": "reach", "horizon": 2}},
        ...     collect=CollectSettings(train_episodes={"reach": 1}, valid_episodes=1),
        ... )
        >>> with Run(settings) as run:
        ...     collect(run)
        ...     run.transitions("reach", "train").shape
        torch.Size([2])
    """
    run.check_open()
    settings = run.settings.collect
    recorded = [task for task in run.tasks if task.record is not None]
    if recorded:
        collect_demonstrations(
            run.data_dir,
            recorded,
            settings.train_episodes,
            valid_episodes=settings.valid_episodes,
            context_episodes=settings.context_episodes,
            noise=settings.noise,
            gains=settings.gains,
            seed=run.settings.seed,
            workers=run.settings.workers,
            after=settings.after,
            experts=settings.experts,
        )
    _import_files(run)
    # Agents keep the normalisation that they were trained with, on another machine too.
    if check_demonstrations(run.data_dir, run.tasks):
        statistics = read_statistics(run.data_dir)
    else:
        statistics = write_statistics(run.data_dir, run.tasks)
    for task in run.tasks:
        if task.files is not None and task.make_env is not None:
            make_env(task, statistics).close()  # raises an error for a wrong environment


def _import_files(run: Run) -> None:
    tasks = [task for task in run.tasks if task.files is not None]
    missing = [task for task in tasks if not demonstration_path(run.data_dir, task.name).exists()]
    if not missing:
        return
    without_env = [task for task in tasks if "env" not in task.options]
    shared = join_bounds([_bounds_of_files(task) for task in without_env]) if without_env else None
    with progress(len(missing), "importing demonstrations", "file") as bar:
        for task in missing:
            assert task.files is not None
            target = demonstration_path(run.data_dir, task.name)
            try:
                import_demonstrations(
                    task.files.path,
                    target,
                    options=_options(task),
                    valid_share=task.files.valid_share,
                    context=run.settings.distill.reads_contexts,
                    bounds=_bounds_of_env(task) or shared,
                )
            except DataError as error:
                if error.key == f"mask/{CONTEXT_MASK}":
                    error.message += f", or settings that read none: {READ_NONE}"
                raise
            try:
                run.check_files()
            except BMRLError:  # replaced since the run was opened
                target.unlink()
                raise
            bar.update(1)
            check_stop()


def read_episode(run: Run, task: Task, index: int, *, context: bool = False) -> Episode:
    """One episode of a task's files, with actions scaled as in the run's demonstrations.

    Args:
        run: the run, whose demonstrations are complete.
        task: a task with files; it need not be one of the run's.
        index: number of the episode, from 0.
        context: count the episodes of another behaviour, instead of the others.

    Raises:
        DataError: as :func:`.read_scaled_episode`.
    """
    if task.name in run.names:  # scaled already
        path = run.demonstrations(task.name)
        bounds = read_original_bounds(path)
        return read_scaled_episode(path, index, bounds=bounds or (-1.0, 1.0), context=context)
    assert task.files is not None
    bounds = _bounds_of_env(task) or read_original_bounds(run.demonstrations(run.names[0]))
    return read_scaled_episode(
        task.files.path,
        index,
        options=_options(task),
        bounds=bounds or (-1.0, 1.0),
        context=context,
    )


def _bounds_of_env(task: Task) -> Bounds | None:
    """Bounds of a gymnasium environment's actions; ``None`` for a task without one."""
    if "env" not in task.options:
        return None
    return action_bounds(task.options["env"], task.options.get("env_options"))


def _options(task: Task) -> ReadOptions:
    assert task.files is not None
    parts = {} if task.parts is None else {"observation_keys": task.parts}
    return ReadOptions.from_mapping({**task.files.read, **parts})


def _bounds_of_files(task: Task) -> Bounds:
    assert task.files is not None
    return find_action_bounds(task.files.path, options=_options(task))
