"""Adds finished runs to the CSV files of docs/results and writes docs/results.md from them.

    python docs/results/publish.py runs/two_stage-paper-seed1 runs/two_stage-paper-seed2
    python docs/results/publish.py            # writes the page again
    python docs/results/publish.py --check    # exits with 1 if the page is not what the files give

A run replaces an earlier one with the same preset, ablation and seed.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torchrl_bmrl.run.as_command  # noqa: F401 -- errors at import become one line

# isort: split
from published import (
    TASKS,
    CurveRow,
    RunRow,
    read_curve_rows,
    read_published,
    write_published,
)
from results_page import check_results_page, write_results_page

from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.files import read_json
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.folder import deciding, read_settings, read_versions
from torchrl_bmrl.training.checkpoint import load_checkpoint

DOCS = Path(__file__).resolve().parents[1]
RECIPES = DOCS.parent / "recipes"
STAGES = ("collect", "stage 1", "stage 2", "evaluate")


def publish(runs: Sequence[Path], docs: Path = DOCS) -> Path:
    """Adds the runs to the CSV files and writes the page.

    Returns:
        path of the page.

    Raises:
        BMRLError: if a file of a run is missing or not valid; nothing is written then.
    """
    published = read_published(docs / "results")
    for run_dir in runs:
        run = read_run(run_dir)
        rows = read_results(run_dir / "results.csv")
        if (path := run_dir / "baselines.csv").exists():
            rows += read_results(path)
        for row in rows:
            if row.seed != run.seed:
                message = f"{row.seed}; the run's is {run.seed}"
                raise DataError(run_dir / "results.csv", "seed", message)
        published = published.with_run(run, rows, read_curves(run_dir, run.seed))
    write_published(docs / "results", published)
    return write_results_page(docs)


def read_run(run_dir: Path) -> RunRow:
    """Reads a run's settings, versions, times and accuracy from its folder."""
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
    """Reads the rollouts after each epoch of stage 1, for those tasks that have them."""
    files = {task: run_dir / "bcq" / task / "evaluations.csv" for task in TASKS}
    return [
        row
        for task, path in files.items()
        if path.is_file()
        for row in read_curve_rows(path, task=task, seed=seed)
    ]


def command_of(settings: Mapping[str, Any]) -> str:
    """Returns the command that gives the settings of a run's ``config.yaml``.

    Settings that differ from the run's preset and ablation become overrides. Settings that did not
    exist when the run was made keep their defaults.

    Raises:
        ConfigError: if the preset, the ablation or a setting of the run no longer exists.
    """
    sys.path.append(str(RECIPES))
    import command  # noqa: F401 -- registers the schema of recipe.yaml
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    choices = []
    for kind in ("preset", "ablation"):
        valid = sorted(path.stem for path in (RECIPES / "config" / kind).glob("*.yaml"))
        if (name := settings.get(kind)) not in valid:
            raise ConfigError(f"{kind} is {name} in the run; valid: {', '.join(valid)}")
        choices.append(f"{kind}={name}")
    if not GlobalHydra.instance().is_initialized():
        hydra.initialize_config_dir(str(RECIPES / "config"), version_base="1.3")
    usual = deciding(OmegaConf.to_container(hydra.compose("recipe", choices), resolve=False))
    differing = {key: x for key, x in deciding(settings).items() if usual.get(key, ...) != x}
    for key in sorted(differing.keys() - usual.keys()):
        raise ConfigError(f"{key} is a setting of the run; valid: those of today's recipes")
    seed = differing.pop("seed", 0)
    words = [choice for choice in choices if choice != "ablation=none"]
    words += [f"seed={seed}", *(f"{key}={json.dumps(value)}" for key, value in differing.items())]
    return shlex.join(["python", "recipes/two_stage.py", *words])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of finished runs")
    parser.add_argument("--check", action="store_true", help="check the page, write nothing")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the page")
    options = parser.parse_args()
    if options.check and options.runs:
        parser.error("--check takes no runs")
    with exit_codes():
        if options.check:
            check_results_page(options.docs)
        else:
            print(publish(options.runs, options.docs))


if __name__ == "__main__":
    main()
