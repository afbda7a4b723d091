"""``results.csv``: one row per evaluated episode, from which every table is computed."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.statistics import bootstrap_interval
from torchrl_bmrl.files import (
    finite,
    flag,
    one_of,
    parse_row,
    read_rows,
    whole,
    write_atomic,
)
from torchrl_bmrl.names import TASKS

POLICIES: tuple[str, ...] = (
    "expert",
    "bcq",
    "distilled",
    "bc",
    "td3_bc",
    "iql",
    "cql",
    "bcq_one_hot",
)
"""The policies that a run compares, in the order of the tables."""

RESULT_COLUMNS: Mapping[str, Callable[[str], Any]] = {
    "task": one_of(*TASKS),
    "policy": one_of(*POLICIES),
    "latent_source": str,
    "seed": whole,
    "episode": whole,
    "return": finite,
    "success": flag,
}
"""Columns of ``results.csv``, and what makes a value of a text."""
RESULT_FIELDS: tuple[str, ...] = tuple(RESULT_COLUMNS)
"""Names of the columns of ``results.csv``, in their order."""


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One evaluated episode.

    Args:
        task: One of :data:`torchrl_bmrl.names.TASKS`.
        policy: One of :data:`POLICIES`.
        latent_source: Where the distilled policy took ``task_latent`` from; empty for the others.
        seed: Seed of the training run that the policy comes from.
        episode: Number of the episode within its task, policy, source and seed.
        episode_return: Undiscounted sum of the rewards (column ``return``).
        success: Whether the task's goal was met at some step.

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
    success: bool


@dataclass(frozen=True, kw_only=True)
class Summary:
    """All episodes of one task, policy and source of ``task_latent``.

    Args:
        task: One of :data:`torchrl_bmrl.names.TASKS`.
        policy: One of :data:`POLICIES`.
        latent_source: Empty but for the distilled policy.
        episodes: Number of episodes, over all seeds.
        seeds: Number of different seeds.
        mean_return: Mean return over the episodes.
        std_return: Standard deviation over the episodes (n - 1 in the denominator; 0 for one).
        return_interval: 95% bootstrap interval of the mean return, stratified by seed.
        success_rate: Share of successful episodes, in [0, 1].
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
    success_rate: float
    success_interval: tuple[float, float]


def read_results(path: str | os.PathLike[str]) -> list[ResultRow]:
    """Reads a ``results.csv``; columns beyond :data:`RESULT_FIELDS` are ignored.

    Args:
        path: The file.

    Returns:
        The rows in the file's order.

    Raises:
        DataError: if the file or a column is missing, or a value is not valid; the message names
            the file, line, column, value and what is valid.

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
    rows = read_rows(path, RESULT_COLUMNS)
    return [result_row(row, Path(path), line) for line, row in enumerate(rows, start=2)]


def result_row(values: Mapping[str, Any], path: Path, line: int) -> ResultRow:
    """The row of the values of :data:`RESULT_COLUMNS`.

    Args:
        values: By column.
        path: The file that they are from, for the message.
        line: Number of the line in it, for the message.

    Raises:
        DataError: if the distilled policy has no source of ``task_latent``, or another one has.
    """
    policy, source = values["policy"], values["latent_source"]
    if (policy == "distilled") != bool(source):
        expected = "a source's name" if policy == "distilled" else "nothing"
        message = f"value in line {line} is {source!r}; expected {expected} for policy {policy}"
        raise DataError(path, "latent_source", message)
    others = {name: values[name] for name in RESULT_FIELDS if name != "return"}
    return ResultRow(episode_return=values["return"], **others)


def write_results(path: str | os.PathLike[str], rows: Iterable[ResultRow]) -> None:
    """Writes a ``results.csv`` atomically; reading it gives the same rows, returns bit by bit.

    Args:
        path: The file to write or replace.
        rows: The episodes.

    Raises:
        DataError: if :func:`read_results` would refuse a row; the old file then stays.

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
            # repr of a Python float is the shortest text that reads back as the same float.
            "return": repr(float(row.episode_return)),
            "success": str(int(row.success)),
        }
        result_row(parse_row(record, RESULT_COLUMNS, path, line), path, line)
        writer.writerow(record)
    write_atomic(path, text.getvalue())


def summarise(rows: Iterable[ResultRow]) -> list[Summary]:
    """One summary per task, policy and source of ``task_latent``.

    Args:
        rows: Episodes in any order; the order does not change a number.

    Returns:
        Summaries in the order of :data:`torchrl_bmrl.names.TASKS`, then :data:`POLICIES`, then
        sources by name.

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
    order = sorted(groups, key=lambda key: (TASKS.index(key[0]), POLICIES.index(key[1]), key[2]))
    return [_summary(key, groups[key]) for key in order]


def _summary(key: tuple[str, str, str], rows: list[ResultRow]) -> Summary:
    # Resampling picks by position, so a fixed order makes the intervals independent of the file's.
    rows = sorted(rows, key=lambda row: (row.seed, row.episode, row.episode_return, row.success))
    seeds = [row.seed for row in rows]
    returns = np.array([row.episode_return for row in rows], dtype=np.float64)
    successes = np.array([row.success for row in rows], dtype=np.float64)
    return Summary(
        task=key[0],
        policy=key[1],
        latent_source=key[2],
        episodes=len(rows),
        seeds=len(set(seeds)),
        mean_return=float(returns.mean()),
        std_return=float(returns.std(ddof=1)) if len(rows) > 1 else 0.0,
        return_interval=bootstrap_interval(returns, strata=seeds),
        success_rate=float(successes.mean()),
        success_interval=bootstrap_interval(successes, strata=seeds),
    )
