"""Hydra finds this plugin because it lies beside the recipes, in the namespace of its plugins."""

from __future__ import annotations

import importlib
import inspect
import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.utils import JobReturn
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from torchrl_bmrl.errors import StoppedError


def run_job(main: Callable[[DictConfig], None], cwd: str, config: DictConfig) -> str | None:
    """Runs a job of a sweep, in this process or another one.

    Args:
        main: the recipe's, importable by name.
        cwd: what relative paths start from; processes of a cluster run elsewhere.
        config: of the job.

    Returns:
        what went wrong, so that the other jobs go on.
    """
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        # joblib's: workers would be told of it at their start and not know it.
        multiprocessing.set_start_method("spawn", force=True)
    try:
        os.chdir(cwd)
        main(config)
    except SystemExit as stop:
        if isinstance(stop.__cause__, StoppedError | KeyboardInterrupt):  # the whole sweep's
            raise
        return f"error: {stop.__cause__ or stop}"
    except Exception:
        return traceback.format_exc()
    return None


class ReportingSweeper(BasicSweeper):
    """Hydra's sweeper; at the end it names all jobs that failed, and the exit code is 1."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Gives the launcher the recipe as a module.

        The functions of a script would be copied to other processes, where a recipe's workers could
        not find them by their names.
        """
        module = importlib.import_module(Path(inspect.getfile(task_function)).stem)
        job = partial(run_job, getattr(module, task_function.__name__), os.getcwd())
        super().setup(hydra_context=hydra_context, task_function=job, config=config)

    def sweep(self, arguments: list[str]) -> Any:
        """Launches the jobs; exits if any failed."""
        batches: list[Sequence[JobReturn]] = super().sweep(arguments)
        jobs = [job for batch in batches for job in batch]
        failed = [job for job in jobs if job.return_value is not None]
        if failed:
            lines = [f"{len(failed)} of {len(jobs)} jobs failed, the others are done:"]
            lines += [f"{' '.join(job.overrides)}\n    {job.return_value}" for job in failed]
            sys.exit("\n".join(lines))
        return batches
