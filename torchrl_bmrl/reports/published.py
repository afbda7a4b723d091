"""The results that a repository publishes: three CSV files, which its page is computed from.

``episodes.csv``, ``curves.csv`` and ``runs.csv`` hold what finished runs measured: every evaluated
episode, the rollouts after every epoch of stage 1, and what each run was. Their order is fixed, so
that equal results are equal files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.results import (
    POLICIES,
    RESULT_COLUMNS,
    ResultRow,
    result_row,
)
from torchrl_bmrl.files import finite, flag, one_of, read_rows, whole, write_rows
from torchrl_bmrl.names import TASKS

MAIN = ("paper", "none")
"""Preset and ablation of the runs that are put beside the paper, and whose curves are kept."""

Key = tuple[str, str, int]
"""What tells runs apart: preset, ablation and seed."""


@dataclass(frozen=True, kw_only=True)
class RunRow:
    """A finished run.

    Attributes:
        preset: its preset.
        ablation: what was changed in it, or ``"none"``.
        seed: its seed.
        command: what runs it again.
        commit: of the code; empty where it is not known.
        versions: of what it uses, as text.
        accuracy: held-out accuracy of the task classifier, in [0, 1]; ``None`` without stage 2.
        task_latent_dim: dimensions of m.
        seconds_collect: wall-clock time of the demonstrations [s]; ``None`` where it was not taken.
        seconds_stage_1: of stage 1 [s].
        seconds_stage_2: of stage 2 [s].
        seconds_evaluate: of the evaluation and the run's report [s].
        device: that trained.
        workers: processes side by side.
    """

    preset: str
    ablation: str
    seed: int
    command: str
    commit: str
    versions: str
    accuracy: float | None
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
    """An evaluated episode and the run that it belongs to, whose seed it has."""

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
    """All that is published.

    Attributes:
        episodes: every evaluated episode.
        curves: rollouts during stage 1 of the runs of :data:`MAIN`.
        runs: the runs.
    """

    episodes: Sequence[EpisodeRow] = ()
    curves: Sequence[CurveRow] = ()
    runs: Sequence[RunRow] = ()

    def with_run(
        self, run: RunRow, rows: Iterable[ResultRow], curves: Iterable[CurveRow]
    ) -> Published:
        """The same with a run, in place of an earlier one of its preset, ablation and seed.

        Args:
            run: the run.
            rows: its episodes.
            curves: its rollouts during stage 1; they are kept of a run of :data:`MAIN` alone.

        Example:
            >>> run = RunRow(
            ...     preset="paper", ablation="none", seed=1, command="", commit="", versions="",
            ...     accuracy=0.99, task_latent_dim=2, seconds_collect=None, seconds_stage_1=None,
            ...     seconds_stage_2=None, seconds_evaluate=None, device="cpu", workers=2,
            ... )  # fmt: skip
            >>> len(Published().with_run(run, [], []).with_run(run, [], []).runs)
            1
        """
        episodes = [e for e in self.episodes if e.key != run.key]
        episodes += [EpisodeRow(preset=run.preset, ablation=run.ablation, row=row) for row in rows]
        kept = list(self.curves)
        if (run.preset, run.ablation) == MAIN:
            kept = [c for c in kept if c.seed != run.seed] + list(curves)
        runs = [r for r in self.runs if r.key != run.key] + [run]
        return Published(episodes=episodes, curves=kept, runs=runs)


def read_curve_rows(path: Path, *, task: str, seed: int) -> list[CurveRow]:
    """The rollouts that stage 1 wrote for a task: ``evaluations.csv``.

    Raises:
        DataError: if the file or a column is missing, or a value is not valid.
    """
    columns = {name: parse for name, parse in _CURVES.items() if name not in ("task", "seed")}
    rows = read_rows(path, columns)
    return [_curve_row({"task": task, "seed": seed, **row}) for row in rows]


def read_published(folder: Path) -> Published:
    """Reads the three files of a folder; a folder without ``runs.csv`` holds nothing.

    Raises:
        DataError: if a file is missing, a value is not valid, a row is there twice, or an episode
            or a curve is of a run that ``runs.csv`` does not have.

    Example:
        >>> read_published(Path("no-such-folder"))
        Published(episodes=[], curves=[], runs=[])
    """
    files = [folder / f"{name}.csv" for name in ("episodes", "curves", "runs")]
    if not files[2].is_file():
        return Published(episodes=[], curves=[], runs=[])
    episodes = read_rows(files[0], {"preset": _text, "ablation": _text, **RESULT_COLUMNS})
    published = Published(
        episodes=[
            EpisodeRow(
                preset=values["preset"],
                ablation=values["ablation"],
                row=result_row(values, files[0], line),
            )
            for line, values in enumerate(episodes, start=2)
        ],
        # No run of MAIN, no curves.
        curves=[_curve_row(row) for row in read_rows(files[1], _CURVES)]
        if files[1].is_file()
        else [],
        runs=[RunRow(**row) for row in read_rows(files[2], _RUNS)],
    )
    runs = {run.key for run in published.runs}
    _check_unique(files[0], [_episode_order(e) for e in published.episodes])
    _check_unique(files[1], [_curve_order(c) for c in published.curves])
    _check_unique(files[2], [run.key for run in published.runs])
    for path, keys in (
        (files[0], {e.key for e in published.episodes}),
        (files[1], {(*MAIN, c.seed) for c in published.curves}),
    ):
        for key in sorted(keys - runs):
            raise DataError(path, None, f"run {key} (preset, ablation, seed) is not in runs.csv")
    return published


def write_published(folder: Path, published: Published) -> None:
    """Writes the three files, each atomically, in a fixed order; returns have three decimals.

    Args:
        folder: where ``episodes.csv``, ``curves.csv`` and ``runs.csv`` go; one without rows is left
            out.
        published: what they hold.
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
            "success": int(e.row.success),
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
        {name: "" if value is None else value for name, value in vars(run).items()}
        for run in sorted(published.runs, key=lambda run: _run_order(run.key))
    ]
    for name, rows in {"episodes": episodes, "curves": curves, "runs": runs}.items():
        if rows:
            write_rows(folder / f"{name}.csv", rows)


def _curve_row(values: Mapping[str, Any]) -> CurveRow:
    values = dict(values)
    return CurveRow(episode_return=values.pop("return"), **values)


def _run_order(key: Key) -> tuple[Any, ...]:
    """Runs of MAIN first, and those without a change before those with one."""
    return key[0] != MAIN[0], key[0], key[1] != MAIN[1], *key[1:]


def _episode_order(episode: EpisodeRow) -> tuple[Any, ...]:
    row = episode.row
    where = TASKS.index(row.task), POLICIES.index(row.policy), row.latent_source
    return *_run_order(episode.key), *where, row.episode


def _curve_order(row: CurveRow) -> tuple[Any, ...]:
    return TASKS.index(row.task), row.seed, row.epoch, row.update, row.episode


def _check_unique(path: Path, keys: Sequence[tuple[Any, ...]]) -> None:
    lines: dict[tuple[Any, ...], int] = {}
    for line, key in enumerate(keys, start=2):
        if (first := lines.setdefault(key, line)) != line:
            raise DataError(path, None, f"line {line} is of the same as line {first}; valid: one")


def _text(text: str) -> str:
    if not text:
        raise ValueError("a name")
    return text


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
    "preset": _text,
    "ablation": _text,
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
