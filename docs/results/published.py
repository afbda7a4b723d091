"""The published results: CSV files from which the pages are computed.

``episodes.csv`` contains every evaluated episode, ``curves.csv`` rollouts after the epochs of stage
1, ``diagnostics.csv`` the last diagnostics of the agents, and ``runs.csv`` the runs. The order of
the rows is fixed, so equal results give equal files. Runs on weak demonstrations have files of
their own.
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
from torchrl_bmrl.reports.paper import TABLE_1
from torchrl_bmrl.rows import finite, flag, one_of, read_rows, whole, write_rows

TASKS = tuple(TABLE_1)
"""The paper's six tasks, in the order of its tables."""
MAIN = ("paper", "none")
"""Preset and ablation of the runs that are compared with the paper; all their curves are kept."""
WEAK = ("weak_paper", "none")
"""Preset and ablation of the main runs on weak demonstrations."""
WEAK_PRESETS = (WEAK[0], "weak")
"""Presets on the page of weak demonstrations; the curves of their last epoch are kept."""

Key = tuple[str, str, int]
"""Preset, ablation and seed, which identify a run."""


@dataclass(frozen=True, kw_only=True)
class _RowOfRun:
    """The first columns of a row that belongs to a run."""

    preset: str
    ablation: str
    seed: int

    @property
    def key(self) -> Key:
        """Preset, ablation and seed of the run."""
        return self.preset, self.ablation, self.seed


@dataclass(frozen=True, kw_only=True)
class RunRow(_RowOfRun):
    """A finished run; a time [s] is ``None`` if it was not measured, or its stage was not run."""

    command: str  # runs it again
    commit: str  # of the code; empty if unknown
    versions: str
    accuracy: float | None  # of the task classifier, held out, in [0, 1]; None: stage 1 alone
    task_latent_dim: int
    seconds_collect: float | None
    seconds_stage_1: float | None
    seconds_stage_2: float | None
    seconds_evaluate: float | None
    device: str
    workers: int

    @property
    def evaluated(self) -> bool:
        """Whether the run has a distilled policy and an evaluation, not stage 1 alone."""
        return self.accuracy is not None


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
class CurveRow(_RowOfRun):
    """A rollout of a BCQ policy after an epoch of its training."""

    task: str
    epoch: int
    update: int
    episode: int
    episode_return: float
    success: bool


@dataclass(frozen=True, kw_only=True)
class DiagnosticsRow(_RowOfRun):
    """The last diagnostics of a task's agent; the gap is ``None`` if it is not defined."""

    task: str
    update: int
    spread_ratio: float
    relative_gap: float | None
    outside_share: float


@dataclass(frozen=True, kw_only=True)
class Published:
    """The content of the files of a folder."""

    episodes: Sequence[EpisodeRow] = ()
    curves: Sequence[CurveRow] = ()
    diagnostics: Sequence[DiagnosticsRow] = ()
    runs: Sequence[RunRow] = ()

    def with_run(
        self,
        run: RunRow,
        rows: Iterable[ResultRow],
        curves: Iterable[CurveRow],
        diagnostics: Iterable[DiagnosticsRow] = (),
    ) -> Published:
        """Adds a run; it replaces an earlier one with the same preset, ablation and seed."""
        episodes = [e for e in self.episodes if e.key != run.key]
        episodes += [EpisodeRow(preset=run.preset, ablation=run.ablation, row=row) for row in rows]
        return Published(
            episodes=episodes,
            curves=[c for c in self.curves if c.key != run.key] + _kept_curves(run, curves),
            diagnostics=[d for d in self.diagnostics if d.key != run.key] + list(diagnostics),
            runs=[r for r in self.runs if r.key != run.key] + [run],
        )


def read_curve_rows(path: Path, *, run: Key, task: str) -> list[CurveRow]:
    """Reads the rollouts of one task's stage 1 from its ``evaluations.csv``."""
    preset, ablation, seed = run
    known = {"preset": preset, "ablation": ablation, "task": task, "seed": seed}
    columns = {column: parse for column, parse in _CURVES.items() if column not in known}
    return [_curve_row({**known, **row}) for row in read_rows(path, columns)]


def _kept_curves(run: RunRow, curves: Iterable[CurveRow]) -> list[CurveRow]:
    """Returns the rollouts that are published: all, those of the last epoch, or none."""
    rows = list(curves)
    if run.key[:2] == MAIN:
        return rows
    if run.preset not in WEAK_PRESETS:
        return []
    last: dict[str, int] = {}
    for row in rows:
        last[row.task] = max(row.epoch, last.get(row.task, 0))
    return [row for row in rows if row.epoch == last[row.task]]


def read_published(folder: Path) -> Published:
    """Reads the files of a folder; without ``runs.csv`` the result is empty.

    Raises:
        DataError: if ``episodes.csv`` is missing beside a run with an evaluation, a value is not
            valid, a row occurs twice, or a row belongs to a run that is not in ``runs.csv``.
    """
    files = [folder / f"{file}.csv" for file in ("episodes", "curves", "diagnostics", "runs")]
    if not files[3].is_file():
        return Published(episodes=[], curves=[], diagnostics=[], runs=[])
    runs = [RunRow(**row) for row in read_rows(files[3], _RUNS)]
    columns = {"preset": name, "ablation": name, **RESULT_COLUMNS, "task": one_of(*TASKS)}
    evaluated = any(run.evaluated for run in runs)
    episodes = [
        EpisodeRow(
            preset=values["preset"],
            ablation=values["ablation"],
            row=result_row(values, files[0], line),
        )
        for line, values in enumerate(_optional_rows(files[0], columns, evaluated), start=2)
    ]
    curves = [_curve_row(r) for r in _optional_rows(files[1], _CURVES)]
    diagnostics = [DiagnosticsRow(**r) for r in _optional_rows(files[2], _DIAGNOSTICS)]
    _check_unique(files[0], [_episode_order(e) for e in episodes])
    _check_unique(files[1], [_curve_order(c) for c in curves])
    _check_unique(files[2], [_agent_order(d) for d in diagnostics])
    _check_unique(files[3], [run.key for run in runs])
    for path, keys in (
        (files[0], {e.key for e in episodes}),
        (files[1], {c.key for c in curves}),
        (files[2], {d.key for d in diagnostics}),
    ):
        for key in sorted(keys - {run.key for run in runs}):
            raise DataError(path, None, f"run {key} (preset, ablation, seed) is not in runs.csv")
    return Published(episodes=episodes, curves=curves, diagnostics=diagnostics, runs=runs)


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
            "preset": c.preset,
            "ablation": c.ablation,
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
    diagnostics = [_record(d) for d in sorted(published.diagnostics, key=_agent_order)]
    runs = [_record(run) for run in sorted(published.runs, key=lambda run: _run_order(run.key))]
    for file, rows in {
        "episodes": episodes,
        "curves": curves,
        "diagnostics": diagnostics,
        "runs": runs,
    }.items():
        if rows:
            write_rows(folder / f"{file}.csv", rows)


def _curve_row(values: Mapping[str, Any]) -> CurveRow:
    values = dict(values)
    return CurveRow(episode_return=values.pop("return"), **values)


def _record(row: RunRow | DiagnosticsRow) -> dict[str, Any]:
    return {column: "" if value is None else value for column, value in vars(row).items()}


def _run_order(key: Key) -> tuple[Any, ...]:
    """Sorts the presets of the main runs first, and runs without an ablation before the others."""
    return key[0] not in (MAIN[0], WEAK[0]), key[0], key[1] != "none", *key[1:]


def _episode_order(episode: EpisodeRow) -> tuple[Any, ...]:
    row = episode.row
    place = TASKS.index(row.task), policy_order(row.policy), row.latent_source, row.episode
    return *_run_order(episode.key), *place


def _curve_order(row: CurveRow) -> tuple[Any, ...]:
    key = row.preset, row.ablation  # the seed comes after the task
    place = TASKS.index(row.task), row.seed, row.epoch, row.update, row.episode
    return *_run_order((*key, 0)), *place


def _agent_order(row: DiagnosticsRow) -> tuple[Any, ...]:
    return *_run_order(row.key), TASKS.index(row.task)


def _optional_rows(
    path: Path, columns: Mapping[str, Callable[[str], Any]], required: bool = False
) -> list[dict[str, Any]]:
    """Reads the rows of a file; without the file there are none unless it is required."""
    return read_rows(path, columns) if required or path.is_file() else []


def _check_unique(path: Path, keys: Sequence[tuple[Any, ...]]) -> None:
    lines: dict[tuple[Any, ...], int] = {}
    for line, key in enumerate(keys, start=2):
        if (first := lines.setdefault(key, line)) != line:
            raise DataError(path, None, f"line {line} repeats line {first}; valid: one of them")


def _optional(text: str) -> float | None:
    return finite(text) if text else None


_RUN: Mapping[str, Callable[[str], Any]] = {"preset": name, "ablation": name, "seed": whole}
_CURVES: Mapping[str, Callable[[str], Any]] = {
    **_RUN,
    "task": one_of(*TASKS),
    "epoch": whole,
    "update": whole,
    "episode": whole,
    "return": finite,
    "success": flag,
}
_DIAGNOSTICS: Mapping[str, Callable[[str], Any]] = {
    **_RUN,
    "task": one_of(*TASKS),
    "update": whole,
    "spread_ratio": finite,
    "relative_gap": _optional,
    "outside_share": finite,
}
_RUNS: Mapping[str, Callable[[str], Any]] = {
    **_RUN,
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
