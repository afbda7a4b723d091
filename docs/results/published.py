"""The published results: three CSV files from which the results page is computed.

``episodes.csv`` has every evaluated episode, ``curves.csv`` the rollouts after every epoch of stage
1, ``runs.csv`` the runs. Their order is fixed, so that equal results give equal files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.results import (
    RESULT_COLUMNS,
    ResultRow,
    name,
    policy_order,
    result_row,
)
from torchrl_bmrl.files import finite, flag, one_of, read_rows, whole, write_rows
from torchrl_bmrl.reports.paper import TABLE_1

TASKS = tuple(TABLE_1)
"""The paper's six tasks, in the order of its tables."""
MAIN = ("paper", "none")
"""Preset and ablation of the runs that are compared with the paper; only their curves are kept."""

Key = tuple[str, str, int]
"""Preset, ablation and seed, which identify a run."""


@dataclass(frozen=True, kw_only=True)
class RunRow:
    """A finished run; a time [s] is ``None`` if it was not measured."""

    preset: str
    ablation: str
    seed: int
    command: str  # runs it again
    commit: str  # of the code; empty if unknown
    versions: str
    accuracy: float | None  # held-out accuracy of the task classifier, in [0, 1]
    task_latent_dim: int
    seconds_collect: float | None
    seconds_stage_1: float | None
    seconds_stage_2: float | None
    seconds_evaluate: float | None
    device: str
    workers: int

    @property
    def key(self) -> Key:
        """Preset, ablation and seed."""
        return self.preset, self.ablation, self.seed


@dataclass(frozen=True, kw_only=True)
class EpisodeRow:
    """An evaluated episode and its run, which has the same seed."""

    preset: str
    ablation: str
    row: ResultRow

    @property
    def key(self) -> Key:
        """Preset, ablation and seed of the run."""
        return self.preset, self.ablation, self.row.seed


@dataclass(frozen=True, kw_only=True)
class CurveRow:
    """A rollout of a BCQ policy after an epoch of its training, in a run of :data:`MAIN`."""

    task: str
    seed: int
    epoch: int
    update: int
    episode: int
    episode_return: float
    success: bool


@dataclass(frozen=True, kw_only=True)
class Published:
    """The content of the three files."""

    episodes: Sequence[EpisodeRow] = ()
    curves: Sequence[CurveRow] = ()
    runs: Sequence[RunRow] = ()

    def with_run(
        self, run: RunRow, rows: Iterable[ResultRow], curves: Iterable[CurveRow]
    ) -> Published:
        """Adds a run; it replaces an earlier one with the same preset, ablation and seed."""
        episodes = [e for e in self.episodes if e.key != run.key]
        episodes += [EpisodeRow(preset=run.preset, ablation=run.ablation, row=row) for row in rows]
        kept = list(self.curves)
        if (run.preset, run.ablation) == MAIN:
            kept = [c for c in kept if c.seed != run.seed] + list(curves)
        runs = [r for r in self.runs if r.key != run.key] + [run]
        return Published(episodes=episodes, curves=kept, runs=runs)


def read_curve_rows(path: Path, *, task: str, seed: int) -> list[CurveRow]:
    """Reads the rollouts of one task's stage 1 from its ``evaluations.csv``."""
    columns = {column: parse for column, parse in _CURVES.items() if column not in ("task", "seed")}
    rows = read_rows(path, columns)
    return [_curve_row({"task": task, "seed": seed, **row}) for row in rows]


def read_published(folder: Path) -> Published:
    """Reads the three files of a folder; without ``runs.csv`` the result is empty.

    Raises:
        DataError: if a file is missing, a value is not valid, a row occurs twice, or an episode or
            a curve belongs to a run that is not in ``runs.csv``.
    """
    files = [folder / f"{file}.csv" for file in ("episodes", "curves", "runs")]
    if not files[2].is_file():
        return Published(episodes=[], curves=[], runs=[])
    columns = {"preset": name, "ablation": name, **RESULT_COLUMNS, "task": one_of(*TASKS)}
    episodes = [
        EpisodeRow(
            preset=values["preset"],
            ablation=values["ablation"],
            row=result_row(values, files[0], line),
        )
        for line, values in enumerate(read_rows(files[0], columns), start=2)
    ]
    # Without runs of MAIN there is no file of curves.
    curves = [_curve_row(r) for r in read_rows(files[1], _CURVES)] if files[1].is_file() else []
    runs = [RunRow(**row) for row in read_rows(files[2], _RUNS)]
    _check_unique(files[0], [_episode_order(e) for e in episodes])
    _check_unique(files[1], [_curve_order(c) for c in curves])
    _check_unique(files[2], [run.key for run in runs])
    for path, keys in (
        (files[0], {e.key for e in episodes}),
        (files[1], {(*MAIN, c.seed) for c in curves}),
    ):
        for key in sorted(keys - {run.key for run in runs}):
            raise DataError(path, None, f"run {key} (preset, ablation, seed) is not in runs.csv")
    return Published(episodes=episodes, curves=curves, runs=runs)


def write_published(folder: Path, published: Published) -> None:
    """Writes the files in a fixed order, with three decimals of each return.

    A file without rows is left out.
    """
    episodes = [
        {
            "preset": e.preset,
            "ablation": e.ablation,
            "task": e.row.task,
            "policy": e.row.policy,
            "latent_source": e.row.latent_source,
            "seed": e.row.seed,
            "episode": e.row.episode,
            "return": f"{e.row.episode_return:.3f}",
            "success": "" if e.row.success is None else int(e.row.success),
        }
        for e in sorted(published.episodes, key=_episode_order)
    ]
    curves = [
        {
            "task": c.task,
            "seed": c.seed,
            "epoch": c.epoch,
            "update": c.update,
            "episode": c.episode,
            "return": f"{c.episode_return:.3f}",
            "success": int(c.success),
        }
        for c in sorted(published.curves, key=_curve_order)
    ]
    runs = [
        {column: "" if value is None else value for column, value in vars(run).items()}
        for run in sorted(published.runs, key=lambda run: _run_order(run.key))
    ]
    for file, rows in {"episodes": episodes, "curves": curves, "runs": runs}.items():
        if rows:
            write_rows(folder / f"{file}.csv", rows)


def _curve_row(values: Mapping[str, Any]) -> CurveRow:
    values = dict(values)
    return CurveRow(episode_return=values.pop("return"), **values)


def _run_order(key: Key) -> tuple[Any, ...]:
    """Sorts the preset of MAIN first, and runs without an ablation before those with one."""
    return key[0] != MAIN[0], key[0], key[1] != MAIN[1], *key[1:]


def _episode_order(episode: EpisodeRow) -> tuple[Any, ...]:
    row = episode.row
    place = TASKS.index(row.task), policy_order(row.policy), row.latent_source, row.episode
    return *_run_order(episode.key), *place


def _curve_order(row: CurveRow) -> tuple[Any, ...]:
    return TASKS.index(row.task), row.seed, row.epoch, row.update, row.episode


def _check_unique(path: Path, keys: Sequence[tuple[Any, ...]]) -> None:
    lines: dict[tuple[Any, ...], int] = {}
    for line, key in enumerate(keys, start=2):
        if (first := lines.setdefault(key, line)) != line:
            raise DataError(path, None, f"line {line} repeats line {first}; valid: one of them")


def _optional(text: str) -> float | None:
    return finite(text) if text else None


_CURVES: Mapping[str, Callable[[str], Any]] = {
    "task": one_of(*TASKS),
    "seed": whole,
    "epoch": whole,
    "update": whole,
    "episode": whole,
    "return": finite,
    "success": flag,
}
_RUNS: Mapping[str, Callable[[str], Any]] = {
    "preset": name,
    "ablation": name,
    "seed": whole,
    "command": str,
    "commit": str,
    "versions": str,
    "accuracy": _optional,
    "task_latent_dim": whole,
    "seconds_collect": _optional,
    "seconds_stage_1": _optional,
    "seconds_stage_2": _optional,
    "seconds_evaluate": _optional,
    "device": str,
    "workers": whole,
}
