"""Random results and embeddings of the six tasks for the tests of the reports."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np

from torchrl_bmrl.evaluation import ResultRow
from torchrl_bmrl.reports import Embeddings, Table, paper, task_titles

ARMS = [("expert", ""), ("bcq", ""), ("distilled", "prototype"), ("distilled", "online")]
TASKS = tuple(paper.TABLE_1)
TITLES = task_titles(TASKS)
NAMES = list(TITLES.values())


def make_rows(tasks: tuple[str, ...] = TASKS) -> list[ResultRow]:
    """Five episodes of two seeds for each policy and task."""
    rng = np.random.default_rng(0)
    return [
        ResultRow(
            task=task,
            policy=policy,
            latent_source=source,
            seed=seed,
            episode=episode,
            episode_return=float(rng.normal(200, 20)),
            success=bool(rng.random() < 0.8),
        )
        for task in tasks
        for policy, source in ARMS
        for seed in (0, 1)
        for episode in range(5)
    ]


def make_embeddings(dim: int = 2) -> Embeddings:
    """Six tasks of three episodes of eight steps, in a shuffled order."""
    rng = np.random.default_rng(1)
    task, episode, step = (a.ravel() for a in np.meshgrid(range(6), range(3), range(8)))
    shuffle = rng.permutation(task.size)
    task, episode, step = task[shuffle], episode[shuffle], step[shuffle]
    latent = rng.normal(size=(task.size, dim)) + 5.0 * task[:, None]
    return Embeddings(
        tasks=TASKS,
        task_latent=latent,
        task=task,
        episode=episode,
        step=step,
        distance=0.3 / (1 + step),
        success=step >= 6,
        phase=np.where(task == 0, 0, step // 3),
        phase_names={
            t: ("reach",) if t == "reach" else ("descend", "grasp", "lift") for t in TASKS
        },
        baselines={"raw transition": rng.normal(size=(task.size, 5))},
    )


def make_known(dim: int = 2, seed: int = 0) -> Embeddings:
    """Embeddings whose stages differ in direction and whose goal distance is their norm."""
    data = make_embeddings(dim)
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(3, dim))[data.phase]
    direction += 0.05 * rng.normal(size=direction.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = np.where(data.step < 6, data.distance, 0.0)
    return replace(data, task_latent=40.0 * distance[:, None] * direction)


def mean(rows: list[ResultRow], task: str, policy: str, source: str = "") -> float:
    """Mean return of a policy in a task."""
    returns = [
        r.episode_return
        for r in rows
        if (r.task, r.policy, r.latent_source) == (task, policy, source)
    ]
    return sum(returns) / len(returns)


def cells(table: Table) -> list[dict[str, str]]:
    """Rows of a table by its header, read from its CSV."""
    return list(csv.DictReader(io.StringIO(table.csv())))
