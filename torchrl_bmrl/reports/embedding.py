"""Embedded transitions and the measures computed on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.embedding import (
    STAGE_TAIL,
    GoalDistanceResult,
    StageResult,
    distance_correlations,
    find_stages,
    mean_estimate,
    spread_ratio,
    stage_agreement,
    until_success,
)

EMBEDDING = "embedding"
"""Name of the embedding m itself, beside those of ``Embeddings.baselines``."""


@dataclass(frozen=True, kw_only=True)
class Embeddings:
    """Embedded transitions, one per row.

    Args:
        tasks: Names of the tasks; a task's position is its class index.
        task_latent: Embeddings m, shape ``(N, d)``.
        task: Class index, shape ``(N,)``.
        episode: Episode within its task, shape ``(N,)``.
        step: Step within its episode, shape ``(N,)``.
        distance: Distance to the goal, shape ``(N,)``, [m]; NaN, the default, where unknown.
        success: Whether the transition meets the task's goal, shape ``(N,)``; ``False`` by default.
        phase: The expert's phase, an index into its task's ``phase_names``, shape ``(N,)``; 0 by
            default.
        phase_names: Names of the phases by task, for tasks whose phases were recorded.
        baselines: Other representations of the same transitions by name, each ``(N, k)``.

    Raises:
        BMRLError: if a shape does not fit, an embedding or a distance is infinite, a class index
            has no task, or a phase has no name.

    Example:
        >>> zeros = np.zeros(3, dtype=int)
        >>> Embeddings(
        ...     tasks=["pour"], task_latent=np.zeros((3, 2)), task=zeros, episode=zeros, step=zeros
        ... ).task_latent.shape
        (3, 2)
    """

    tasks: Sequence[str]
    task_latent: NDArray[Any]
    task: NDArray[np.integer[Any]]
    episode: NDArray[np.integer[Any]]
    step: NDArray[np.integer[Any]]
    distance: NDArray[np.floating[Any]] = None  # type: ignore[assignment]  # filled below
    success: NDArray[np.bool_] = None  # type: ignore[assignment]
    phase: NDArray[np.integer[Any]] = None  # type: ignore[assignment]
    phase_names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    baselines: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.task_latent.ndim != 2 or self.task_latent.shape[1] == 0:
            raise BMRLError(f"task_latent must have shape (N, d), got {self.task_latent.shape}")
        expected = (len(self.task_latent),)
        for name, default in (("distance", np.nan), ("success", False), ("phase", 0)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(expected, default))
        for name in ("task", "episode", "step", "distance", "success", "phase"):
            if (shape := getattr(self, name).shape) != expected:
                raise BMRLError(f"{name} must have shape {expected}, got {shape}")
        for name, values in {"task_latent": self.task_latent, **self.baselines}.items():
            if values.ndim != 2 or len(values) != len(self.task_latent):
                raise BMRLError(f"{name} must have shape ({expected[0]}, k), got {values.shape}")
            if not np.isfinite(values).all():
                raise BMRLError(f"{name} must be finite; it contains NaN or infinite values")
        if np.isinf(self.distance).any():
            raise BMRLError("distance must be finite, or NaN where unknown; it is infinite")
        if not ((self.task >= 0) & (self.task < len(self.tasks))).all():
            raise BMRLError(
                f"task must lie in [0, {len(self.tasks)}), got {np.unique(self.task).tolist()}"
            )
        for task, names in self.phase_names.items():
            numbers = np.unique(self.phase[self._is(task)])
            if not np.isin(numbers, np.arange(len(names))).all():
                raise BMRLError(
                    f"phase contains {numbers.tolist()} for {task}; valid: 0 to {len(names) - 1}, "
                    f"for {', '.join(names)}"
                )

    def rows(self, keep: NDArray[Any]) -> Embeddings:
        """Selects rows.

        Args:
            keep: mask ``(N,)``, or indices.
        """
        others = ("tasks", "phase_names", "baselines")
        columns = [f.name for f in fields(self) if f.name not in others]
        return replace(
            self,
            **{name: getattr(self, name)[keep] for name in columns},
            baselines={name: values[keep] for name, values in self.baselines.items()},
        )

    def in_time(self) -> Embeddings:
        """Sorts the rows by task, episode and step."""
        return self.rows(np.lexsort((self.step, self.episode, self.task)))

    def on_the_way(self, task: str, *, tail: int = 0) -> Embeddings:
        """Selects a task's transitions up to the first success of their episode, in time.

        Args:
            task: name of the task.
            tail: number of steps after the success that are also selected.
        """
        own = self.rows(self._is(task)).in_time()
        if not len(own.task):
            return own
        return own.rows(until_success(own.success, own.episode, own.step, tail=tail))

    def in_stages(self, task: str) -> Embeddings:
        """Selects a task's transitions in which stages are searched.

        These are the transitions of its successful episodes up to :data:`STAGE_TAIL` steps after
        the first success. In an episode that fails, an early stage lasts to the end.

        Args:
            task: name of the task.
        """
        way = self.on_the_way(task, tail=STAGE_TAIL)
        return way.rows(np.isin(way.episode, way.episode[way.success]))

    @property
    def representations(self) -> dict[str, NDArray[Any]]:
        """The embedding and the baselines by name."""
        return {EMBEDDING: self.task_latent, **self.baselines}

    def _is(self, task: str) -> NDArray[np.bool_]:
        return self.task == (self.tasks.index(task) if task in self.tasks else -1)


def name_stages(
    training: Embeddings, held_out: Embeddings, task: str, *, seed: int = 0
) -> dict[str, NDArray[np.int64]]:
    """Groups a task's held-out transitions, into as many groups as phases occur in training.

    Returns:
        By representation, the group of each row of ``held_out.in_stages(task)``.
    """
    train, test = (x.in_stages(task) for x in (training, held_out))
    count = len(np.unique(train.phase))
    return {
        name: find_stages(train.representations[name], points, count, seed=seed)
        for name, points in test.representations.items()
    }


def measure_stages(
    training: Embeddings, held_out: Embeddings, *, seed: int = 0
) -> list[StageResult]:
    """Compares groups of each task's transitions, found without labels, with recorded phases.

    The groups are fitted to the training transitions and applied to the held-out ones, for m and
    for each baseline. There are as many groups as phases occur in training.

    Args:
        training: Transitions that the groups are fitted to.
        held_out: Transitions on which the agreement is measured.
        seed: Seed of the groups and of the bootstrap.

    Returns:
        One result for each task with more than one phase and transitions in both data sets.
    """
    results = []
    for task, names in held_out.phase_names.items():
        train, test = (x.in_stages(task) for x in (training, held_out))
        phases = [names[number] for number in np.unique(train.phase)]
        if len(phases) < 2 or len(train.task) < len(phases) or not len(test.task):
            continue
        results.append(
            StageResult(
                task=task,
                phases=phases,
                agreement={
                    name: stage_agreement(stage, test.phase, test.episode, seed=seed)
                    for name, stage in name_stages(training, held_out, task, seed=seed).items()
                },
                episodes=len(np.unique(test.episode)),
                transitions=len(test.task),
            )
        )
    return results


def success_point(training: Embeddings, task: str) -> dict[str, NDArray[Any]] | None:
    """Computes the mean over the episodes' first successes of a task, by representation.

    Returns:
        Point ``(k,)`` of the embedding and of each baseline; ``None`` if no episode succeeds.
    """
    way = training.on_the_way(task)
    if not way.success.any():
        return None
    return {name: x[way.success].mean(0) for name, x in way.representations.items()}


def measure_goal_distance(
    training: Embeddings, held_out: Embeddings, *, seed: int = 0
) -> list[GoalDistanceResult]:
    """Compares distances to the success point with distances to the goal, task by task.

    Args:
        training: Transitions that give the success point.
        held_out: Transitions on which the correlation is measured.
        seed: Seed of the bootstrap.

    Returns:
        One result for each task with a success in training and held-out transitions whose
        distance to the goal is known.
    """
    results = []
    for task in held_out.tasks:
        test, point = held_out.on_the_way(task), success_point(training, task)
        if point is None or not len(test.task) or np.isnan(test.distance).any():
            continue
        each = {
            name: distance_correlations(x, point[name], test.distance, test.episode)
            for name, x in test.representations.items()
        }
        solved = np.unique(test.episode[test.success])
        start = test.task_latent[(test.step == 0) & np.isin(test.episode, solved)]
        end = test.task_latent[test.success]
        met = len(solved) > 1 and len(start) == len(end) and np.ptp(start, axis=0).any()
        results.append(
            GoalDistanceResult(
                task=task,
                correlation={name: mean_estimate(x, seed=seed) for name, x in each.items()},
                lowest=float(each[EMBEDDING].min()),
                spread=spread_ratio(start, end, seed=seed) if met else None,
                episodes=len(each[EMBEDDING]),
                transitions=len(test.task),
            )
        )
    return results
