"""A run of the two stages: its settings, its tasks and the files in its folder."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.demonstrations import (
    check_demonstrations,
    demonstration_path,
    has_contexts,
    load_transitions,
    read_statistics,
)
from torchrl_bmrl.envs.gym import max_episode_steps
from torchrl_bmrl.envs.transforms import ObservationStatistics, make_env
from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome, evaluate_policy
from torchrl_bmrl.families import Family, find_family
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.pipeline.agents import load_bcq_loss
from torchrl_bmrl.pipeline.metadata import check_statistics
from torchrl_bmrl.pipeline.settings import SIX_TASKS, Settings
from torchrl_bmrl.pipeline.student import Student, load_student
from torchrl_bmrl.pipeline.task_files import (
    check_contexts,
    check_names,
    input_files,
    make_tasks,
    read_task_file,
    train_episodes,
    with_run_options,
)
from torchrl_bmrl.run.folder import check_files, check_made_from
from torchrl_bmrl.run.locks import WHOLE_RUN, lock_run
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.tasks import Task, compose_tasks, import_module_of

log = logging.getLogger(__name__)

Job = TypeVar("Job")
Result = TypeVar("Result")


class Run:
    """A run folder as an object; ``with run:`` creates or opens the folder and locks it.

    Workers receive a copy by pickle. All results are read from the folder.

    Args:
        settings: settings of the run. A YAML file of tasks is stored in the folder's settings.

    Attributes:
        settings: the settings, with tasks and numbers of episodes filled in.
        folder: the run folder.
        tasks: the tasks; a task's class index is its position.

    Raises:
        BMRLError: for settings that are not valid.

    Example:
        >>> import tempfile
        >>> run = Run(Settings(run_dir=tempfile.mkdtemp(), tasks=["reach", "lift"]))
        >>> run.settings.collect.train_episodes["lift"]
        80
        >>> with run:
        ...     run.seed("collect", "lift", 3) == run.seed("collect", "lift", 4)
        False
    """

    _opened: ExitStack | None = None  # the lock; copies of the run do not have it

    def __init__(self, settings: Settings) -> None:
        tasks = list(SIX_TASKS) if settings.tasks is None else settings.tasks
        if isinstance(tasks, str):
            tasks = read_task_file(tasks)
        made = make_tasks(tasks)
        if settings.robot and not any("robot" in task.options for task in made):
            raise ConfigError(f"robot is {settings.robot}; valid for tasks without robosuite: null")
        self.tasks = tuple(with_run_options(task, settings) for task in made)
        check_names(settings, self.tasks)
        self.folder = Path(settings.run_dir)
        check_contexts(settings, self.tasks)
        episodes = train_episodes(settings, self.tasks)
        collect = replace(settings.collect, train_episodes=episodes)
        self.settings = replace(settings, tasks=tasks, collect=collect)
        if settings.distill.task_encoder == "told":
            self.codes()  # tasks of no family are an error before anything is trained
        if (only := settings.only) is not None:
            unknown = [name for name in only if name not in self.names]
            if not only or unknown or len(set(only)) < len(only):
                raise ConfigError(f"only is {only}; valid: some of {list(self.names)}, each once")

    def __enter__(self) -> Run:
        # Jobs that train only some tasks lock these, so that other jobs can train the rest.
        parts = self.settings.only or [WHOLE_RUN, *self.names]
        settings, defaults = asdict(self.settings), asdict(Settings())
        with ExitStack() as opened:
            files = input_files(self.settings, self.tasks)
            opened.enter_context(lock_run(self.folder, settings, parts, defaults, files))
            check_demonstrations(self.data_dir, self.tasks)
            self._opened = opened.pop_all()
        gc.freeze()  # robosuite collects garbage at every env.close(): leave imported modules out
        return self

    def __exit__(self, *error: Any) -> bool | None:
        assert self._opened is not None
        opened, self._opened = self._opened, None
        return opened.__exit__(*error)

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in ("settings", "folder", "tasks")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for name in self._chosen:  # a worker knows no families but the library's
            import_module_of("task", name)

    @property
    def _chosen(self) -> list[str]:
        """The names that the settings give for the tasks; none for descriptions by name."""
        tasks = self.settings.tasks
        return [] if isinstance(tasks, Mapping) else list(tasks)

    # -- tasks ---------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tasks."""
        return tuple(task.name for task in self.tasks)

    @property
    def titles(self) -> dict[str, str]:
        """Titles of the tasks by name, for tables and figures."""
        return {task.name: task.title for task in self.tasks}

    @property
    def playable(self) -> bool:
        """Whether every task has an environment."""
        return all(task.make_env is not None for task in self.tasks)

    def task(self, name: str) -> Task:
        """Returns a task of the run.

        Args:
            name: name of the task.

        Raises:
            UnknownNameError: for a name that is not a task of the run.
        """
        if name not in self.names:
            raise UnknownNameError("task of the run", name, self.names)
        return self.tasks[self.names.index(name)]

    @property
    def family(self) -> Family:
        """The family whose trained members are the tasks of the run.

        Raises:
            ConfigError: if they are not those of one family.
        """
        return find_family(self._chosen, self.names)

    def codes(self) -> list[tuple[float, ...]]:
        """Numbers that a policy is given which is told the task, for each task of the family."""
        family = self.family
        return [family.told(name) for name in self.names]

    def composition(self, name: str) -> Task:
        """Returns a composition of the run's tasks.

        Args:
            name: names of the tasks, such as ``"reach-lift"``.

        Raises:
            ConfigError: for a name that is not a task of the run, or tasks that cannot be composed.
        """
        return compose_tasks([self.task(part) for part in name.split("-")])

    # -- files ---------------------------------------------------------------------------------

    @property
    def data_dir(self) -> Path:
        """Folder of the demonstrations, ``<task>.hdf5``, and their statistics."""
        return self.folder / "data"

    def check_files(self) -> None:
        """Refuses files that the settings name if they have another content than before."""
        check_files(self.folder, input_files(self.settings, self.tasks))

    @property
    def student_path(self) -> Path:
        """The distilled policy: this run's checkpoint, or the exported file of the settings."""
        if self.settings.evaluate.policy:
            return Path(self.settings.evaluate.policy)
        return self.folder / "distill" / "checkpoint.safetensors"

    def demonstrations(self, name: str) -> Path:
        """Returns the file with a task's demonstrations.

        Args:
            name: name of the task.
        """
        return demonstration_path(self.data_dir, name)

    def agent_path(self, name: str) -> Path:
        """Returns the checkpoint of a stage-1 agent.

        Args:
            name: name of the agent; a task's first agent has the task's name.
        """
        return self.folder / "bcq" / name / "checkpoint.safetensors"

    @cached_property
    def statistics(self) -> ObservationStatistics:
        """Mean and scale of the observation over all tasks' training demonstrations."""
        return read_statistics(self.data_dir)

    def transitions(self, name: str, split: str) -> TensorDictBase:
        """Returns a task's normalised transitions, ``[N]``.

        Args:
            name: name of the task.
            split: ``"train"``, ``"valid"`` or ``"context"``.
        """
        index = self.names.index(name)
        return load_transitions(
            self.data_dir, self.tasks[index], self.statistics, split=split, index=index
        )

    @property
    def has_contexts(self) -> bool:
        """Whether the demonstrations of every task have episodes of another behaviour."""
        return all(has_contexts(self.demonstrations(name)) for name in self.names)

    def teacher(self, name: str, path: Path | None = None) -> BCQLoss:
        """Returns a trained agent, frozen.

        Args:
            name: name of the agent.
            path: its checkpoint; by default that of stage 1.

        Raises:
            CheckpointError: also if its observations were normalised with other statistics.
        """
        path = path or self.agent_path(name)
        loss, metadata = load_bcq_loss(path)
        check_statistics(path, metadata, self.statistics)
        return loss

    def student(self) -> tuple[Student, dict[str, Any]]:
        """Returns the distilled student and its metadata; refused as :meth:`teacher`."""
        student, metadata = self.policy()
        check_statistics(self.student_path, metadata, self.statistics)
        return student, metadata

    def policy(self) -> tuple[Student, dict[str, Any]]:
        """Returns the same, also for an exported policy, which has statistics of its own."""
        found = load_student(self.student_path)
        if self.settings.evaluate.policy:
            self.check_files()
        return found

    def once(
        self,
        file: str,
        read: Callable[[Path], Result],
        make: Callable[[Path], Any],
        *,
        skipped: Callable[[], Any] = lambda: None,
        of: Sequence[Path] = (),
    ) -> Result:
        """Returns the content of a file, which is written first if it does not exist.

        Args:
            file: path below the run folder.
            read: reads the file.
            make: writes the file atomically.
            skipped: called if the file exists; reports the work that is not done again.
            of: policies whose result it is; a file of others is an error (:func:`check_made_from`).
        """
        path = self.folder / file
        check_made_from(path, of)
        if path.exists():
            log.debug("%s: loaded", path)
            skipped()
        else:
            make(path)
        return read(path)

    # -- work ----------------------------------------------------------------------------------

    def check_open(self) -> None:
        """Checks that this process has opened and locked the folder.

        Raises:
            BMRLError: if the run is not open.
        """
        if self._opened is None:
            raise BMRLError(f"{self.folder} is not open; valid: with Run(settings) as run: ...")

    def seed(self, *names: str | int) -> int:
        """Derives a seed for one purpose from the run's seed."""
        return derive_seed(self.settings.seed, *names)

    def jobs(
        self,
        function: Callable[[tuple[Run, Job], Report], Result],
        jobs: Iterable[Job],
        *,
        total: int,
        description: str,
        unit: str,
        workers: int | None = None,
    ) -> list[Result]:
        """Calls ``function((run, job), report)`` for every job in the run's workers.

        See :func:`~torchrl_bmrl.run.workers.run_jobs`.

        Args:
            function: runs one job; it must be importable by name.
            jobs: the jobs.
            total: units of all jobs, for the progress.
            description: name of the jobs.
            unit: name of a unit, in the singular.
            workers: number of processes; by default that of the settings.

        Raises:
            BMRLError: if the run is not open, or a job fails.
        """
        self.check_open()
        return run_jobs(
            function,
            [(self, job) for job in jobs],
            workers=workers or self.settings.workers,
            total=total,
            description=description,
            unit=unit,
            preload=[task.simulator for task in self.tasks if task.simulator],
        )

    def make_env(self, task: Task, *transforms: Transform, num_envs: int) -> TransformedEnv:
        """Returns a task's environment with this run's normalisation.

        Args:
            task: a task of this run, or a composition.
            *transforms: appended.
            num_envs: of parallel episodes.
        """
        return make_env(task, self.statistics, *transforms, num_envs=num_envs)

    def play(
        self,
        task: Task,
        policy: TensorDictModuleBase,
        *transforms: Transform,
        seeds: Sequence[int],
        statistics: ObservationStatistics | None = None,
        report: Report = lambda steps: None,
    ) -> list[EpisodeOutcome]:
        """Plays one episode per seed, all in parallel.

        Args:
            task: a task of this run, or a composition.
            policy: writes ``action``.
            *transforms: appended to the environment, such as a source of ``task_latent``.
            seeds: seeds of the episodes.
            statistics: statistics of the policy's observation; by default this run's.
            report: called with the number of new steps.
        """
        statistics = statistics or self.statistics
        with closing(make_env(task, statistics, *transforms, num_envs=len(seeds))) as env:
            return evaluate_policy(env, policy, seeds, max_steps=self.horizon(task), report=report)

    def horizon(self, task: Task) -> int:
        """Steps after which an episode is cut off.

        The task's horizon; without one gymnasium's, or the length of the longest demonstration.

        Args:
            task: of the run, one of its compositions, or a held-out member of its family.
        """
        horizon = task.horizon
        if horizon is None and "env" in task.options:
            horizon = max_episode_steps(task.options["env"], task.options.get("env_options"))
        if horizon is not None:
            return horizon
        names = [task.name] if task.name in self.names else self.names
        return 1 + max(int(self.transitions(name, "train")["step"].max()) for name in names)
