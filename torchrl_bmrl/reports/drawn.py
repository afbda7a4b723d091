"""Figures and tables of embeddings, the part of a report that takes longest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchrl_bmrl.reports.drawing import FEWEST_MAPPED
from torchrl_bmrl.reports.embedding import (
    EMBEDDING,
    Embeddings,
    measure_goal_distance,
    measure_stages,
    name_stages,
    success_point,
)
from torchrl_bmrl.reports.embedding_figures import (
    embedding_scatter,
    embedding_stages,
    embedding_trajectories,
    embedding_tsne,
)
from torchrl_bmrl.reports.page import Picture
from torchrl_bmrl.reports.tables import Table, goal_distance_table, stages_table


@dataclass(frozen=True, kw_only=True)
class DrawnEmbeddings:
    """What a report shows of embeddings.

    Attributes:
        shown: Figures of the embedding by file name.
        shown_notes: What is left out of these.
        tables: Tables of stages and distances by file name.
        measured: Figures of stages by file name.
        measured_notes: What is left out of these.
    """

    shown: dict[str, Picture]
    shown_notes: list[str]
    tables: dict[str, Table]
    measured: dict[str, Picture]
    measured_notes: list[str]


def draw_embeddings(
    embeddings: Embeddings | None,
    training: Embeddings | None,
    titles: Mapping[str, str],
    *,
    seed: int = 0,
) -> DrawnEmbeddings:
    """Draws and measures embeddings, which takes longer than the rest of a report.

    Args:
        embeddings: as of :func:`write_report`.
        training: likewise.
        titles: Titles by task, for every task.
        seed: as of :func:`write_report`.
    """
    shown, shown_notes = _draw_embeddings(embeddings, training, titles, seed=seed)
    tables, measured, notes = _measure_embeddings(embeddings, training, titles, seed=seed)
    return DrawnEmbeddings(
        shown=shown,
        shown_notes=shown_notes,
        tables=tables,
        measured=measured,
        measured_notes=notes,
    )


def _draw_embeddings(
    embeddings: Embeddings | None,
    training: Embeddings | None,
    titles: Mapping[str, str],
    *,
    seed: int,
) -> tuple[dict[str, Picture], list[str]]:
    """Draws the embedding, and notes what is left out."""
    if embeddings is None:
        return {}, ["The figures of the embedding are left out: no transition has one of its own."]
    embeddings = embeddings.in_time()
    latent, task = embeddings.task_latent, embeddings.task
    names = [titles[name] for name in embeddings.tasks]
    pictures = {
        "embedding": Picture(
            png=embedding_scatter(latent, task, names),
            alt="Scatter plot of task embeddings, one colour per task",
            caption=(
                "Each point is the embedding m of one transition (state, action, reward, next "
                "state). Tasks that form separate clusters can be told apart from a single "
                "transition. Compare the paper's figure 4a."
            ),
        ),
    }
    mapped = len(task) >= FEWEST_MAPPED
    notes = [] if mapped else ["The t-SNE map is left out: there are too few transitions."]
    if mapped:
        pictures["embedding_tsne"] = Picture(
            png=embedding_tsne(latent, task, names, seed=seed),
            alt="t-SNE map of task embeddings, one colour per task",
            caption=(
                "The same embeddings after t-SNE, which keeps neighbours together and distorts "
                "distances: several clusters of one colour suggest stages of that task, such as "
                "descending, grasping and lifting. Compare the paper's figure 4b."
            ),
        )
    for name in embeddings.tasks:
        way = embeddings.on_the_way(name)
        if len(way.task) and not np.isnan(way.distance).any():
            break
    else:
        return pictures, [*notes, "The trajectories are left out: no distance to a goal is known."]
    center = None if training is None else success_point(training, name)
    pictures["embedding_trajectories"] = Picture(
        png=embedding_trajectories(
            way.task_latent,
            way.episode,
            way.distance,
            title=titles[name],
            success_point=None if center is None else center[EMBEDDING],
        ),
        alt="Lines through the embedding, one per episode, coloured by distance to the goal",
        caption=(
            f"{titles[name]}: episodes as lines through the embedding, from circle to star, up to "
            "their first success. If the embedding contains the progress of the task, the lines "
            "end in one place and points of one colour lie on a circle around it. The circles are "
            "centred on the success point of the training demonstrations. Each has the colour of "
            "a distance to the goal, and the median radius of the transitions at that distance. "
            "Compare the paper's figure 5 (reach)."
        ),
    )
    return pictures, notes


def _measure_embeddings(
    embeddings: Embeddings | None,
    training: Embeddings | None,
    titles: Mapping[str, str],
    *,
    seed: int,
) -> tuple[dict[str, Table], dict[str, Picture], list[str]]:
    """Measures stages and distances in the embedding, and notes what is left out."""
    if embeddings is None:
        return {}, {}, []
    if training is None:
        return {}, {}, ["Stages and distances are left out: no training transitions were given."]
    notes, tables, pictures = [], {}, {}
    stages = measure_stages(training, embeddings, seed=seed)
    if stages:
        tables["stages"] = stages_table(stages, titles=titles)
    else:
        notes.append("The stages are left out: no phases of the expert were recorded.")
    if distances := measure_goal_distance(training, embeddings, seed=seed):
        tables["goal_distance"] = goal_distance_table(distances, titles=titles)
    else:
        notes.append(
            "The distances are left out: no training demonstration succeeds, or no distance to a "
            "goal is known."
        )
    for task in (result.task for result in stages if result.transitions >= FEWEST_MAPPED):
        way = embeddings.in_stages(task)
        pictures["embedding_stages"] = Picture(
            png=embedding_stages(
                way.task_latent,
                way.phase,
                name_stages(training, embeddings, task, seed=seed)[EMBEDDING],
                embeddings.phase_names[task],
                seed=seed,
            ),
            alt="Two t-SNE maps of one task's embeddings: by recorded phase, and by group found",
            caption=(
                f"{titles[task]}: t-SNE of the embeddings of held-out episodes that succeed, until "
                "half a second after their first success. Left: by the phase that the expert "
                "recorded; right: by the group found without it. Compare the paper's figure 4b."
            ),
        )
        break
    return tables, pictures, notes
