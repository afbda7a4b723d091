"""``results.csv``: one row per evaluated episode. Every table is computed from it."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.evaluation.statistics import bootstrap_interval
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.rows import finite, flag, parse_row, read_rows, to_cell, whole

POLICIES: tuple[str, ...] = (
    "expert",
    "reference",
    "bcq",
    "distilled",
    "bc",
    "bc_best",
    "td3_bc",
    "rebrac",
    "iql",
    "cql",
    "bcq_one_hot",
)
"""Policies that come first in tables, in this order; any other name follows, sorted."""


def name(text: str) -> str:
    """A name: any text that is not empty.

    Raises:
        ValueError: if the text is empty.

    Example:
        >>> name("lift")
        'lift'
    """
    if not text:
        raise ValueError("a name")
    return text


def _optional_flag(text: str) -> bool | None:
    try:
        return flag(text) if text else None
    except ValueError as error:
        raise ValueError(f"{error}, or nothing if unknown") from None


RESULT_COLUMNS: Mapping[str, Callable[[str], Any]] = {
    "task": name,
    "policy": name,
    "latent_source": str,
    "seed": whole,
    "episode": whole,
    "return": finite,
    "success": _optional_flag,
}
"""Columns of ``results.csv`` and the parser of each."""
RESULT_FIELDS: tuple[str, ...] = tuple(RESULT_COLUMNS)
"""Names of the columns of ``results.csv``, in their order."""
_EPISODE = ("task", "policy", "latent_source", "seed", "episode")
"""Columns that tell episodes apart."""


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One evaluated episode.

    Args:
        task: Name of the task.
        policy: Name of the policy, such as one of :data:`POLICIES`.
        latent_source: Where the distilled policy took ``task_latent`` from; empty for the others.
        seed: Seed of the training run that the policy comes from.
        episode: Number of the episode within its task, policy, source and seed.
        episode_return: Undiscounted sum of the rewards (column ``return``).
        success: Whether the task succeeded at some step; ``None`` (an empty cell) if the task
            does not define success.

    Example:
        >>> row = ResultRow(
        ...     task="lift", policy="bcq", seed=0, episode=3, episode_return=151.2, success=True
        ... )
        >>> row.episode_return, row.latent_source
        (151.2, '')
    """

    task: str
    policy: str
    latent_source: str = ""
    seed: int
    episode: int
    episode_return: float
    success: bool | None


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Statistics of all episodes of one task, policy and source of ``task_latent``.

    Args:
        task: Name of the task.
        policy: Name of the policy.
        latent_source: Where ``task_latent`` came from; empty for all but the distilled policy.
        episodes: Number of episodes, over all seeds.
        seeds: Number of different seeds.
        mean_return: Mean return over the episodes.
        std_return: Standard deviation over the episodes (n - 1 in the denominator; 0 for one).
        return_interval: 95% bootstrap interval of the mean return, stratified by seed.
        success_rate: Share of successful episodes, in [0, 1]; ``None`` if success is unknown.
        success_interval: 95% bootstrap interval of the success rate, stratified by seed.

    Example:
        >>> rows = [
        ...     ResultRow(
        ...         task="lift", policy="bcq", seed=i, episode=0, episode_return=80.0, success=True
        ...     )
        ...     for i in range(2)
        ... ]
        >>> (summary,) = summarise(rows)
        >>> summary.seeds, summary.success_rate, summary.return_interval
        (2, 1.0, (80.0, 80.0))
    """

    task: str
    policy: str
    latent_source: str
    episodes: int
    seeds: int
    mean_return: float
    std_return: float
    return_interval: tuple[float, float]
    success_rate: float | None
    success_interval: tuple[float, float] | None


def read_results(path: str | os.PathLike[str]) -> list[ResultRow]:
    """Reads a ``results.csv`` and ignores columns other than :data:`RESULT_FIELDS`.

    Args:
        path: The file.

    Returns:
        The rows in the file's order.

    Raises:
        DataError: if the file or a column is missing, a value is not valid, or an episode has two
            lines.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "results.csv"
        >>> row = ResultRow(
        ...     task="reach", policy="bcq", seed=0, episode=3, episode_return=151.16, success=True
        ... )
        >>> write_results(path, [row])
        >>> read_results(path) == [row]
        True
    """
    lines: dict[tuple[Any, ...], int] = {}
    rows = []
    for line, values in enumerate(read_rows(path, RESULT_COLUMNS), start=2):
        rows.append(result_row(values, Path(path), line))
        episode = tuple(values[name] for name in _EPISODE)
        if (first := lines.setdefault(episode, line)) != line:
            message = f"value in line {line} is {values['episode']}, the episode of line {first}"
            raise DataError(Path(path), "episode", f"{message}; expected each episode once")
    return rows


def result_row(values: Mapping[str, Any], path: Path, line: int) -> ResultRow:
    """Makes a row from the parsed values of one line.

    Args:
        values: Values by column (:data:`RESULT_COLUMNS`).
        path: The file, for the message.
        line: Number of the line, for the message.

    Raises:
        DataError: if the distilled policy has no source of ``task_latent``, or another policy of
            :data:`POLICIES` has one.
    """
    policy, source = values["policy"], values["latent_source"]
    if policy in POLICIES and (policy == "distilled") != bool(source):
        expected = "a source's name" if policy == "distilled" else "nothing"
        message = f"value in line {line} is {source!r}; expected {expected} for policy {policy}"
        raise DataError(path, "latent_source", message)
    others = {name: values[name] for name in RESULT_FIELDS if name != "return"}
    return ResultRow(episode_return=values["return"], **others)


def write_results(path: str | os.PathLike[str], rows: Iterable[ResultRow]) -> None:
    """Writes a ``results.csv`` atomically; reading it returns exactly the same rows.

    Args:
        path: The file to write or replace.
        rows: The episodes.

    Raises:
        DataError: if a row is not valid; an existing file is then left as it was.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "results.csv"
        >>> write_results(path, [])
        >>> path.read_text().strip()
        'task,policy,latent_source,seed,episode,return,success'
    """
    path = Path(path)
    text = io.StringIO()
    writer = csv.DictWriter(text, RESULT_FIELDS, lineterminator="\n")
    writer.writeheader()
    for line, row in enumerate(rows, start=2):
        record = {
            "task": row.task,
            "policy": row.policy,
            "latent_source": row.latent_source,
            "seed": str(int(row.seed)),
            "episode": str(int(row.episode)),
            # repr of a Python float is the shortest text that parses to the same float.
            "return": repr(float(row.episode_return)),
            "success": "" if row.success is None else str(int(row.success)),
        }
        result_row(parse_row(record, RESULT_COLUMNS, path, line), path, line)
        writer.writerow({key: to_cell(text) for key, text in record.items()})
    write_atomic(path, text.getvalue())


def summarise(rows: Iterable[ResultRow], tasks: Iterable[str] = ()) -> list[Summary]:
    """Computes one summary per task, policy and source of ``task_latent``.

    Args:
        rows: Episodes; their order within a group does not change a number.
        tasks: Order of the tasks; tasks that are not in it follow in the order of the rows.

    Returns:
        Summaries in the order of the tasks, then of :func:`policy_order`, then sources by name.

    Raises:
        BMRLError: for returns without a finite mean and standard deviation.

    Example:
        >>> rows = [
        ...     ResultRow(
        ...         task="lift", policy="bcq", seed=0, episode=i, episode_return=i, success=i > 0
        ...     )
        ...     for i in range(4)
        ... ]
        >>> summary = summarise(rows)[0]
        >>> summary.mean_return, summary.success_rate, summary.episodes
        (1.5, 0.75, 4)
    """
    groups: dict[tuple[str, str, str], list[ResultRow]] = {}
    for row in rows:
        groups.setdefault((row.task, row.policy, row.latent_source), []).append(row)
    place = {task: i for i, task in enumerate(dict.fromkeys([*tasks, *(key[0] for key in groups)]))}
    order = sorted(groups, key=lambda key: (place[key[0]], *policy_order(key[1]), key[2]))
    return [_summary(key, groups[key]) for key in order]


def policy_order(policy: str) -> tuple[int, str]:
    """Sort key of a policy's name: those of :data:`POLICIES` first, then the others by name.

    Example:
        >>> sorted(["mine", "bcq", "expert"], key=policy_order)
        ['expert', 'bcq', 'mine']
    """
    return POLICIES.index(policy) if policy in POLICIES else len(POLICIES), policy


def _summary(key: tuple[str, str, str], rows: list[ResultRow]) -> Summary:
    # The bootstrap draws by position: sorting makes the intervals independent of the rows' order.
    rows = sorted(
        rows, key=lambda row: (row.seed, row.episode, row.episode_return, bool(row.success))
    )
    seeds = [row.seed for row in rows]
    returns = np.array([row.episode_return for row in rows], dtype=np.float64)
    outcomes = [row.success for row in rows]
    with np.errstate(over="ignore", invalid="ignore"):
        mean, deviation = returns.mean(), returns.std(ddof=1) if len(rows) > 1 else 0.0
    if not np.isfinite([mean, deviation]).all():
        raise BMRLError(
            f"returns of policy {key[1]} on {key[0]}: up to {np.abs(returns).max()}, with mean "
            f"{mean} and standard deviation {deviation}; valid: finite ones"
        )
    successes = None if None in outcomes else np.array(outcomes, dtype=np.float64)
    return Summary(
        task=key[0],
        policy=key[1],
        latent_source=key[2],
        episodes=len(rows),
        seeds=len(set(seeds)),
        mean_return=float(mean),
        std_return=float(deviation),
        return_interval=bootstrap_interval(returns, strata=seeds),
        success_rate=None if successes is None else float(successes.mean()),
        success_interval=None if successes is None else bootstrap_interval(successes, strata=seeds),
    )
