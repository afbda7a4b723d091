"""A Hydra sweeper that reports all failed jobs; Hydra finds it in ``hydra_plugins``."""

from __future__ import annotations

import importlib
import inspect
import multiprocessing
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from torchrl_bmrl.errors import StoppedError
from torchrl_bmrl.files import write_atomic


def run_job(
    main: Callable[[DictConfig], None], cwd: str, notes: str, config: DictConfig
) -> str | None:
    """Runs a job of a sweep, in this process or another one.

    Args:
        main: the recipe's function, importable by name.
        cwd: working directory; processes of a cluster have another one.
        notes: folder in which the job saves its result, in case the launcher fails.
        config: configuration of the job.

    Returns:
        the job's error, or ``None``; an exception would stop the other jobs.
    """
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        # joblib sets a start method of its own, which spawned workers do not know.
        multiprocessing.set_start_method("spawn", force=True)
    # Here, since Hydra imports this module before a recipe can report a missing extra.
    from torchrl_bmrl.run.progress import name_lines

    problem = None
    try:
        os.chdir(cwd)
        name_lines(str(config.get("run_dir", "")))
        main(config)
    except SystemExit as stop:
        if isinstance(stop.__cause__, StoppedError | KeyboardInterrupt):  # stops the whole sweep
            raise
        problem = f"error: {stop.__cause__ or stop}"
    except Exception:
        problem = traceback.format_exc().rstrip()
    write_atomic(Path(notes) / str(HydraConfig.get().job.num), problem or "")
    return problem


class ReportingSweeper(BasicSweeper):
    """Hydra's sweeper, which lists all failed jobs at the end and exits with code 1."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Imports the recipe as a module for the launcher.

        Functions of a script would be copied to other processes, in which a recipe's workers could
        not import them.
        """
        module = importlib.import_module(Path(inspect.getfile(task_function)).stem)
        self.notes = Path(config.hydra.sweep.dir).absolute() / ".jobs"
        main = getattr(module, task_function.__name__)
        job = partial(run_job, main, os.getcwd(), str(self.notes))
        super().setup(hydra_context=hydra_context, task_function=job, config=config)

    def sweep(self, arguments: list[str]) -> Any:
        """Launches the jobs if all are valid; exits if any failed."""
        jobs = self.compose_all(arguments)
        try:
            return self.launch_all(arguments, jobs)
        finally:
            shutil.rmtree(self.notes, ignore_errors=True)

    def compose_all(self, arguments: list[str]) -> list[list[str]]:
        """Returns each job's overrides; exits, before anything is written, if any is not valid."""
        assert self.hydra_context is not None
        assert self.config is not None
        loader = self.hydra_context.config_loader
        lines = [*self._parse_config(), *arguments]
        overrides = OverridesParser.create(config_loader=loader).parse_overrides(lines)
        (jobs,) = self.split_arguments(overrides, None)
        problems = []
        for job in jobs:
            try:
                loader.load_sweep_config(self.config, list(job))
            except (HydraException, OmegaConfBaseException) as error:
                reasons = [str(e).partition("\n")[0] for e in (error, error.__cause__) if e]
                problems.append((job, "; ".join(reasons)))
        if problems:
            end(f"{len(problems)} of {len(jobs)} jobs are not valid; none was started:", problems)
        return jobs

    def validate_batch_is_legal(self, batch: Sequence[Sequence[str]]) -> None:
        """Does nothing: :meth:`compose_all` has checked all jobs."""

    def launch_all(self, arguments: list[str], jobs: list[list[str]]) -> Any:
        """Launches the jobs; exits if any job or the launcher failed."""
        try:
            batches: list[Sequence[JobReturn]] = super().sweep(arguments)
            found = [job.return_value for batch in batches for job in batch]
        except Exception as error:  # the launcher failed: a killed process, a lost cluster
            lost = str(error).strip().partition("\n")[0] or type(error).__name__
            files = [self.notes / str(number) for number in range(len(jobs))]
            found = [
                file.read_text() or None if file.exists() else f"not finished: {lost}"
                for file in files
            ]
        problems = [(job, x) for job, x in zip(jobs, found, strict=True) if x is not None]
        if problems:
            end(f"{len(problems)} of {len(jobs)} jobs failed; the others are done:", problems)
        return batches


def end(summary: str, problems: list[tuple[list[str], str]]) -> NoReturn:
    """Exits with the errors of a sweep, each below its job's overrides."""
    lines = [f"{' '.join(job)}\n    {problem}" for job, problem in problems]
    sys.exit("\n".join([summary, *lines]))
