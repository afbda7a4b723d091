"""Adds finished runs to CSV files below docs/results and writes docs/results.md and docs/weak.md.

    python docs/results/publish.py runs/two_stage-paper-seed1 runs/two_stage-paper-seed2
    python docs/results/publish.py runs/weak_paper-1 --baselines runs/tuned-1  # other coefficients
    python docs/results/publish.py            # writes the pages again
    python docs/results/publish.py --check    # exits with 1 if a page is not what the files give

A run replaces an earlier one with the same preset, ablation and seed. Runs of the presets weak and
weak_paper have a folder and a page of their own, docs/results/weak and docs/weak.md. Their
ablations may be runs of recipes/train_bcq.py alone, which have no evaluation.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torchrl_bmrl.run.as_command  # noqa: F401 -- errors at import become one line

# isort: split
from published import (
    TASKS,
    WEAK,
    WEAK_PRESETS,
    CurveRow,
    DiagnosticsRow,
    Key,
    RunRow,
    read_curve_rows,
    read_published,
    write_published,
)
from results_page import check_results_page, write_results_page
from weak_page import check_weak_page, write_weak_page

from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.evaluation import ResultRow, read_results
from torchrl_bmrl.files import read_json
from torchrl_bmrl.reports.tables import policy_name
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.folder import deciding, read_settings, read_versions
from torchrl_bmrl.studies.algorithms import published as published_coefficients
from torchrl_bmrl.studies.baselines import ALL_TASKS, ONE_HOT, checkpoint_path
from torchrl_bmrl.training.checkpoint import load_checkpoint
from torchrl_bmrl.training.diagnostics import read_diagnostics

DOCS = Path(__file__).resolve().parents[1]
RECIPES = DOCS.parent / "recipes"
STAGES = ("collect", "stage 1", "stage 2", "evaluate")


def publish(
    runs: Sequence[Path], docs: Path = DOCS, *, baselines: Sequence[Path] = ()
) -> list[Path]:
    """Adds the runs to the CSV files and writes the pages.

    Args:
        runs: folders of finished runs.
        docs: folder of the pages.
        baselines: folders with further baselines of these runs, which have other coefficients.

    Returns:
        paths of the pages.

    Raises:
        BMRLError: if a file of a run is missing or not valid, or a folder of baselines belongs to
            none of the runs; nothing is written then.
    """
    further = by_run(baselines)
    folders = [docs / "results", docs / "results" / "weak"]
    published = [read_published(folder) for folder in folders]
    for run_dir in runs:
        run = read_run(run_dir)
        weak = run.preset in WEAK_PRESETS
        published[weak] = published[weak].with_run(
            run,
            read_episodes(run_dir, run, further.pop(run.key, []) if run.evaluated else []),
            read_curves(run_dir, run.key),
            read_agents(run_dir, run.key) if weak else [],
        )
    for key, (first, *_) in further.items():
        message = f"{first} belongs to run {key} (preset, ablation, seed)"
        raise ConfigError(f"{message}; valid: one that is published with it and was evaluated")
    for folder, content in zip(folders, published, strict=True):
        write_published(folder, content)
    pages = [write_results_page(docs), write_weak_page(docs)]
    return [page for page in pages if page is not None]


def read_run(run_dir: Path) -> RunRow:
    """Reads a run's settings, versions, times and accuracy from its folder.

    Raises:
        BMRLError: if a file is missing or not valid, or stage 1 has not ended in a run without a
            distilled policy.
    """
    settings, versions = read_settings(run_dir), read_versions(run_dir)
    path = run_dir / "seconds.json"
    seconds = read_json(path, "the seconds of a run") if path.exists() else {}
    if alone := is_stage_1_alone(run_dir, settings):
        check_stage_1(run_dir, settings)
        accuracy, task_latent_dim = None, settings["distill"]["task_latent_dim"]
    else:
        student = run_dir / "distill" / "checkpoint.safetensors"
        _, metadata = load_checkpoint(student, kind="student")
        accuracy = round(metadata["accuracy"], 5)
        task_latent_dim = metadata["student"]["task_latent_dim"]
    return RunRow(
        preset=settings["preset"],
        ablation=settings["ablation"],
        seed=settings["seed"],
        command=command_of(settings, "train_bcq.py" if alone else "two_stage.py"),
        commit=versions.pop("commit", None) or "",
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
        accuracy=accuracy,
        task_latent_dim=task_latent_dim,
        **{f"seconds_{name.replace(' ', '_')}": seconds.get(name) for name in STAGES},
        device=settings["device"],
        workers=settings["workers"],
    )


def is_stage_1_alone(run_dir: Path, settings: Mapping[str, Any]) -> bool:
    """Whether a run of stage 1 alone may be published: not a main run, and nothing follows it."""
    names = settings.get("preset"), settings.get("ablation")
    later = [run_dir / "distill", run_dir / "results.csv"]
    return names[0] in WEAK_PRESETS and names != WEAK and not any(map(Path.exists, later))


def check_stage_1(run_dir: Path, settings: Mapping[str, Any]) -> None:
    """Checks that the agents of the run's tasks were rolled out after the last epoch.

    Raises:
        DataError: naming the first file that is missing or too short.
    """
    key = settings["preset"], settings["ablation"], settings["seed"]
    last = settings["bcq"]["epochs"]
    for task in settings["tasks"] or TASKS:
        path = run_dir / "bcq" / task / "evaluations.csv"
        epoch = max((row.epoch for row in read_curve_rows(path, run=key, task=task)), default=0)
        if epoch != last:
            raise DataError(path, "epoch", f"the last is {epoch}; valid: {last}, as bcq.epochs")


def by_run(baselines: Sequence[Path]) -> dict[Key, list[Path]]:
    """Groups folders of baselines by preset, ablation and seed."""
    groups: dict[Key, list[Path]] = {}
    for folder in baselines:
        settings = read_settings(folder)
        key = settings["preset"], settings["ablation"], settings["seed"]
        groups.setdefault(key, []).append(folder)
    return groups


def read_episodes(run_dir: Path, run: RunRow, baselines: Sequence[Path] = ()) -> list[ResultRow]:
    """Reads the evaluated episodes of a run; a run of stage 1 alone has none.

    Args:
        run_dir: folder of the run.
        run: its row.
        baselines: folders with further baselines on the same demonstrations.

    Raises:
        BMRLError: if a file is missing or not valid, an episode has another seed than the run, or
            two folders contain the same baseline.
    """
    if not run.evaluated:
        return []
    rows = read_results(run_dir / "results.csv")
    if (run_dir / "baselines.csv").exists():
        rows += read_baselines(run_dir)
    for folder in baselines:
        more, present = read_baselines(folder), {row.policy for row in rows}
        for policy in sorted(present & {row.policy for row in more}):
            message = f"{policy!r} is in {run_dir} or another folder, too; valid: once"
            raise DataError(folder / "baselines.csv", "policy", message)
        rows += more
    for row in rows:
        if row.seed != run.seed:
            message = f"{row.seed}; the run's is {run.seed}"
            raise DataError(run_dir / "results.csv", "seed", message)
    return rows


def read_baselines(folder: Path) -> list[ResultRow]:
    """Reads a folder's baselines; coefficients that are not the published ones join the names.

    Raises:
        BMRLError: if a file or a checkpoint is missing or not valid.
    """
    rows = read_results(folder / "baselines.csv")
    keys = dict.fromkeys((row.policy, row.task) for row in rows)
    names = {key: name_of(folder, *key) for key in keys}
    return [replace(row, policy=names[row.policy, row.task]) for row in rows]


def name_of(folder: Path, policy: str, task: str) -> str:
    """Returns a baseline's name with those of its coefficients that are not the published ones."""
    path = checkpoint_path(folder, policy, ALL_TASKS if policy == ONE_HOT else task)
    given = load_checkpoint(path, kind="baseline")[1].get("coefficients", {})
    usual = published_coefficients(policy)
    other = [f"{key} {value:g}" for key, value in given.items() if usual.get(key) != value]
    return f"{policy_name(policy)} ({', '.join(other)})" if other else policy


def read_curves(run_dir: Path, run: Key) -> list[CurveRow]:
    """Reads the rollouts after each epoch of stage 1, for those tasks that have them."""
    files = {task: run_dir / "bcq" / task / "evaluations.csv" for task in TASKS}
    return [
        row
        for task, path in files.items()
        if path.is_file()
        for row in read_curve_rows(path, run=run, task=task)
    ]


def read_agents(run_dir: Path, run: Key) -> list[DiagnosticsRow]:
    """Reads the last diagnostics of each task's agent, for those tasks that have them."""
    preset, ablation, seed = run
    found = []
    for task in TASKS:
        path = run_dir / "bcq" / task / "diagnostics.csv"
        if path.is_file() and (rows := read_diagnostics(path)):
            last = rows[update := max(rows)]
            gap = last.relative_gap
            row = DiagnosticsRow(
                preset=preset,
                ablation=ablation,
                task=task,
                seed=seed,
                update=update,
                spread_ratio=round(last.spread_ratio, 4),
                relative_gap=round(gap, 4) if math.isfinite(gap) else None,
                outside_share=round(last.outside_share, 4),
            )
            found.append(row)
    return found


def command_of(settings: Mapping[str, Any], recipe: str = "two_stage.py") -> str:
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
    return shlex.join(["python", f"recipes/{recipe}", *words])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of finished runs")
    parser.add_argument("--check", action="store_true", help="check the pages, write nothing")
    parser.add_argument(
        "--baselines", nargs="+", type=Path, default=[], help="further baselines of these runs"
    )
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the pages")
    options = parser.parse_args()
    if options.check and (options.runs or options.baselines):
        parser.error("--check takes no runs")
    with exit_codes(saves=False):
        if options.check:
            check_results_page(options.docs)
            check_weak_page(options.docs)
        else:
            print(*publish(options.runs, options.docs, baselines=options.baselines), sep="\n")


if __name__ == "__main__":
    main()
