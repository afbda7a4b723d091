"""Finished runs into the CSV files of docs/results, and the page docs/results.md from these.

    python recipes/publish.py "runs=[runs/two_stage-paper-seed1,runs/two_stage-paper-seed2]"
    python recipes/publish.py               # the page alone, again
    python recipes/publish.py check=true    # 1 if the page is not what the CSV files give

A run takes the place of an earlier one of its preset, ablation and seed.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
import settings as recipe_settings  # noqa: F401 -- registers what recipe.yaml builds on
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from torchrl_bmrl.checkpoint import load_checkpoint
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports import check_results_page, write_results_page
from torchrl_bmrl.reports.published import (
    CurveRow,
    RunRow,
    read_curve_rows,
    read_published,
    write_published,
)
from torchrl_bmrl.runs import FREE_TO_CHANGE, read_settings, read_versions

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
    preset, command = command_of(settings)
    path = run_dir / "seconds.json"
    try:
        seconds = json.loads(path.read_text()) if path.exists() else {}
    except ValueError as error:
        raise DataError(path, None, f"not the seconds of a run ({error})") from error
    student = run_dir / "distill" / "checkpoint.safetensors"
    _, metadata = load_checkpoint(student, kind="student")
    return RunRow(
        preset=preset,
        ablation=settings.get("ablation", "none"),
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


def command_of(settings: Mapping[str, Any]) -> tuple[str, str]:
    """A run's preset, and the command that gives the settings of its ``config.yaml``.

    Every preset is composed, or the one that the settings name; that from which the fewest settings
    differ is the run's, and these become overrides. Settings that the run did not know yet keep
    their defaults.

    Raises:
        ConfigError: if the run has a setting that there is no more, or its preset is gone.
    """
    ablation = settings.get("ablation", "none")
    presets = sorted(path.stem for path in (RECIPES / "config" / "preset").glob("*.yaml"))
    if (named := settings.get("preset", presets[0])) not in presets:
        raise ConfigError(f"preset is {named} in the run; valid: {', '.join(presets)}")
    told = dict(_flat(settings))
    candidates = []
    for preset in [settings["preset"]] if "preset" in settings else presets:
        choices = [f"preset={preset}", *([f"ablation={ablation}"] if ablation != "none" else [])]
        composed = OmegaConf.to_container(hydra.compose("recipe", choices), resolve=False)
        usual = dict(_flat(composed))
        differing = {key: x for key, x in told.items() if key not in usual or usual[key] != x}
        away = len(differing) + len(usual.keys() - told.keys())
        candidates.append((away, preset, choices, differing, usual))
    _, preset, choices, differing, usual = min(candidates, key=lambda candidate: candidate[0])
    for key in sorted(differing.keys() - usual.keys()):
        raise ConfigError(f"{key} is a setting of the run; valid: those of today's recipes")
    seed = differing.pop("seed", 0)
    overrides = [f"{key}={json.dumps(value)}" for key, value in differing.items()]
    words = ["python", "recipes/two_stage.py", *choices, f"seed={seed}", *overrides]
    return preset, shlex.join(words)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Settings that decide results, by their dotted names."""
    for key, value in settings.items():
        if not prefix and key in FREE_TO_CHANGE:
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


store = ConfigStore.instance()
store.store(name="publish_schema", node=Settings)
store.store(
    name="publish",
    node={
        "defaults": [
            "publish_schema",
            "_self_",
            {"override hydra/hydra_logging": "disabled"},
            {"override hydra/job_logging": "disabled"},
        ],
        "hydra": {"output_subdir": None, "run": {"dir": "."}},
    },
)


@hydra.main(version_base="1.3", config_path="config", config_name="publish")
def main(config: DictConfig) -> None:
    """Command line; an expected error becomes one line and exit code 1."""
    try:
        publish(OmegaConf.to_object(config))
    except BMRLError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
