"""Finished runs into the CSV files of docs/results, and the page docs/results.md from these.

    python recipes/publish.py "runs=[runs/two_stage-paper-seed1,runs/two_stage-paper-seed2]"
    python recipes/publish.py               # the page alone, again
    python recipes/publish.py check=true    # 1 if the page is not what the CSV files give

A run takes the place of an earlier one of its preset, ablation and seed.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
import settings as recipe_settings  # noqa: F401 -- registers what recipe.yaml builds on
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.files import read_json
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports import check_results_page, write_results_page
from torchrl_bmrl.reports.published import (
    CurveRow,
    RunRow,
    read_curve_rows,
    read_published,
    write_published,
)
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.folder import deciding, read_settings, read_versions
from torchrl_bmrl.training.checkpoint import load_checkpoint

RECIPES = Path(__file__).resolve().parent
STAGES = ("collect", "stage 1", "stage 2", "evaluate")


@dataclass
class Settings:
    """What to publish."""

    runs: list[str] = field(default_factory=list)  # folders of finished runs
    check: bool = False  # writes nothing
    docs: str = str(RECIPES.parent / "docs")  # folder of the page


def publish(settings: Settings) -> None:
    """Adds the runs to the CSV files and writes the page, or checks it."""
    docs = Path(settings.docs)
    if settings.check:
        if settings.runs:
            raise ConfigError(f"runs is {settings.runs}; valid with check=true: none")
        check_results_page(docs)
        return
    published = read_published(docs / "results")
    for run_dir in map(Path, settings.runs):
        run = read_run(run_dir)
        rows = read_results(run_dir / "results.csv")
        if (path := run_dir / "baselines.csv").exists():
            rows += read_results(path)
        for row in rows:
            if row.seed != run.seed:
                raise DataError(
                    run_dir / "results.csv", "seed", f"{row.seed}; the run's is {run.seed}"
                )
        published = published.with_run(run, rows, read_curves(run_dir, run.seed))
    write_published(docs / "results", published)
    print(write_results_page(docs))


def read_run(run_dir: Path) -> RunRow:
    """What a run's folder says of it.

    Raises:
        BMRLError: if a file of it is missing or not valid.
    """
    settings, versions = read_settings(run_dir), read_versions(run_dir)
    command = command_of(settings)
    path = run_dir / "seconds.json"
    seconds = read_json(path, "the seconds of a run") if path.exists() else {}
    student = run_dir / "distill" / "checkpoint.safetensors"
    _, metadata = load_checkpoint(student, kind="student")
    return RunRow(
        preset=settings["preset"],
        ablation=settings["ablation"],
        seed=settings["seed"],
        command=command,
        commit=versions.pop("commit", None) or "",
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
        accuracy=round(metadata["accuracy"], 5),
        task_latent_dim=metadata["student"]["task_latent_dim"],
        **{f"seconds_{name.replace(' ', '_')}": seconds.get(name) for name in STAGES},
        device=settings["device"],
        workers=settings["workers"],
    )


def read_curves(run_dir: Path, seed: int) -> list[CurveRow]:
    """The rollouts after each epoch of stage 1, of those tasks that the folder has them of."""
    files = {task: run_dir / "bcq" / task / "evaluations.csv" for task in TASKS}
    return [
        row
        for task, path in files.items()
        if path.is_file()
        for row in read_curve_rows(path, task=task, seed=seed)
    ]


def command_of(settings: Mapping[str, Any]) -> str:
    """The command that gives the settings of a run's ``config.yaml``.

    What differs from its preset and ablation becomes overrides; settings that the run did not know
    yet keep their defaults.

    Raises:
        ConfigError: if the run names no preset or ablation that there is, or has a setting that
            there is no more.
    """
    choices = []
    for kind in ("preset", "ablation"):
        valid = sorted(path.stem for path in (RECIPES / "config" / kind).glob("*.yaml"))
        if (name := settings.get(kind)) not in valid:
            raise ConfigError(f"{kind} is {name} in the run; valid: {', '.join(valid)}")
        choices.append(f"{kind}={name}")
    composed = OmegaConf.to_container(hydra.compose("recipe", choices), resolve=False)
    usual = deciding(composed)
    differing = {key: x for key, x in deciding(settings).items() if usual.get(key, ...) != x}
    for key in sorted(differing.keys() - usual.keys()):
        raise ConfigError(f"{key} is a setting of the run; valid: those of today's recipes")
    seed = differing.pop("seed", 0)
    words = [choice for choice in choices if choice != "ablation=none"]
    words += [f"seed={seed}", *(f"{key}={json.dumps(value)}" for key, value in differing.items())]
    return shlex.join(["python", "recipes/two_stage.py", *words])


ConfigStore.instance().store(name="publish_schema", node=Settings)


@hydra.main(version_base="1.3", config_path="config", config_name="publish")
def main(config: DictConfig) -> None:
    """Command line."""
    with exit_codes():
        publish(OmegaConf.to_object(config))


if __name__ == "__main__":
    main()
