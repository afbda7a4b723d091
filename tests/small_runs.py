"""The smallest run that has every part; its fixtures are in conftest.py."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from torchrl_bmrl import pipeline

RECIPES = Path(__file__).parents[1] / "recipes"
HORIZON = 10
TASKS = {name: {"task": name, "horizon": HORIZON} for name in ("reach", "lift")}
"""The small runs' tasks, for settings that are made in Python."""


def tasks(*names: str) -> str:
    """The override for tasks with short episodes."""
    entries = (f"{name}:{{task:{name},horizon:{HORIZON}}}" for name in names)
    return f"tasks={{{','.join(entries)}}}"


SMALL = [
    "preset=smoke",
    tasks("reach", "lift"),
    "collect.train_episodes.reach=1",
    "collect.train_episodes.lift=1",
    "bcq.epochs=2",
    "bcq.updates_per_epoch=6",
    "bcq.batch_size=8",
    "bcq.num_cells=[16,16]",
    "distill.updates=12",
    "distill.batch_size=8",
    "distill.num_cells=[16,16]",
    "evaluate.num_candidates=5",
    "evaluate.latent_sources=[prototype,online,demonstration]",
    "log_interval=4",
    "checkpoint_interval=4",
]
Run = Callable[..., Path]
"""Runs a recipe's function in a folder, in this process; fixture ``run``."""
STAGES = ("bcq/*/*", "distill/*", "results.csv", "tables/*", "logs/*/scalars/*")
"""Files that training and evaluation write and that are the same whenever a run is repeated."""


def configured(*overrides: str) -> DictConfig:
    """The settings as a command composes them; of two overrides of one key the last one counts."""
    overrides = tuple({each.partition("=")[0]: each for each in overrides}.values())
    with initialize_config_dir(version_base="1.3", config_dir=str(RECIPES / "config")):
        return compose("recipe", overrides=list(overrides))


def make_run(folder: Path, *overrides: str) -> pipeline.Run:
    """The run that the small settings describe, not open."""
    return pipeline.Run(settings_of(*SMALL, f"run_dir={folder}", *overrides))


def study_run(folder: Path, bcq: dict[str, Any] | None = None, **settings: Any) -> pipeline.Run:
    """A small run for a study, from settings made in Python, not open."""
    stage1 = {"epochs": 2, "updates_per_epoch": 6, "batch_size": 8, "num_cells": [16, 16]}
    return pipeline.Run(
        pipeline.Settings(
            run_dir=str(folder),
            workers=1,
            tasks=TASKS,
            collect=pipeline.CollectSettings(train_episodes={"default": 1}, valid_episodes=1),
            bcq=pipeline.BCQSettings(**{**stage1, **(bcq or {})}),
            evaluate=pipeline.EvaluateSettings(episodes=2, num_candidates=5),
            **settings,
        )
    )


def settings_of(*overrides: str) -> pipeline.Settings:
    """Settings of a run that a command line gives, without those of studies."""
    return filled(configured(*overrides))


def filled(config: Any) -> pipeline.Settings:
    """The same of a configuration that is composed already."""
    values = OmegaConf.to_object(config)
    names = [field.name for field in fields(pipeline.Settings)]
    return pipeline.Settings(**{name: getattr(values, name) for name in names})


def recipe(name: str, *overrides: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """Runs a recipe's command line as a person would."""
    return subprocess.run(
        [sys.executable, str(RECIPES / f"{name}.py"), *overrides],
        cwd=cwd,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        timeout=900,
    )


def command_line(recipe: str, *overrides: str) -> int:
    """The same in this process; its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(RECIPES))
        patch.setattr(sys, "argv", [f"{recipe}.py", *overrides])
        try:
            runpy.run_path(str(RECIPES / f"{recipe}.py"), run_name="__main__")
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def started(recipes: Any, name: str, *overrides: str) -> tuple[int, list[Any]]:
    """A recipe's exit code and the settings that it would have run with, and its study's."""
    ran: list[Any] = []

    def run(config: Any, function: Any, **options: Any) -> None:
        original(config, lambda run, *study: ran.extend([run.settings, *study]), **options)

    original = recipes.run_recipe
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recipes, "run_recipe", run)
        return command_line(name, *overrides), ran


def exit_code(run: Run, folder: Path, function: Any, *overrides: str) -> int:
    """Exit code of a recipe that fails or is stopped."""
    with pytest.raises(SystemExit) as end:
        run(folder, function, *overrides)
    return int(end.value.code)  # type: ignore[arg-type]


def contents(folder: Path, *patterns: str) -> dict[str, bytes]:
    """Contents of the files that match one of the patterns, by their paths in the folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for pattern in patterns
        for path in sorted(folder.glob(pattern))
        if path.is_file() and ".locks" not in path.parts  # they name processes
    }


def times(folder: Path) -> dict[str, int]:
    """Modification times of the files that are costly to make."""
    patterns = ("data/*.hdf5", "**/*.safetensors", "evaluation/*.csv", "bcq/*/evaluations.csv")
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for pattern in patterns
        for path in folder.glob(pattern)
    }


class Interruption:
    """A progress callback that stops the job at one of its updates."""

    def __init__(self, update: int, error: type[BaseException]) -> None:
        self.done, self.update, self.error = 0, update, error

    def __call__(self, count: int) -> None:
        self.done += count
        if self.done == self.update:
            raise self.error("stopped by the test")
