"""The tables and figures of ``interpolate.py``; ``docs/interpolation.md`` explains them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from torchrl_bmrl.envs.tasks import CONTROL_FREQUENCY
from torchrl_bmrl.evaluation import bootstrap_interval
from torchrl_bmrl.evaluation.behaviour import (
    CUBE_OUTCOMES,
    cube_outcomes,
    effective_number,
    group_coverage,
    mean_speed,
    occupied_cells,
    spread,
)
from torchrl_bmrl.reports import (
    Picture,
    Table,
    behaviour_trajectories,
    embedding_paths,
    task_name,
)
from torchrl_bmrl.reports.tables import MISSING

METHODS = {
    "prototype": "Nothing: the task's prototype",
    "tasks": "Every task's prototype",
    "straight": "Points of straight lines",
    "curve": "Points of curves on the data",
    "random": "Random points",
    "curve_moving": "Along curves on the data in time",
    "actions": "Random actions",
}
"""Where m comes from, or the action, by the method's name."""
SWITCHES = {
    "stay": "One demonstration to the end",
    "switch": "Another one from halfway on",
    "leave": "Another task's prototype from halfway on",
}
SWITCH_STEPS = 3
"""Steps of the straight line between two demonstrations; a reach arrives after about eleven."""
CELL = 0.04
"""Edge of the cells that are counted [m]."""
GROUP = 5
"""Episodes whose cells are counted together."""
Episodes = Mapping[str, np.ndarray]
"""``eef``, ``cube``: ``(N, T, 3)`` [m]; ``along``, ``deviation``, ``success``: ``(N, T)``."""


def moved(episodes: Episodes, name: str) -> np.ndarray:
    """Positions relative to where each episode began: the starts differ, and are no behaviour."""
    return episodes[name] - episodes[name][:, :1]


def with_interval(values: np.ndarray, form: str) -> str:
    """Mean and its bootstrap interval."""
    low, high = bootstrap_interval(values)
    return f"{values.mean():{form}} [{low:{form}}, {high:{form}}]"


def share_of_neither(task: str, episodes: Episodes, tasks: Episodes) -> str:
    """Share of episodes in which the cube fares as at neither end of the episode's path."""
    labels = list(zip(tasks["label"], cube_outcomes(moved(tasks, "cube")), strict=True))
    usual = {
        other: Counter(outcome for label, outcome in labels if label == other).most_common(1)[0][0]
        for other in {label for label, _ in labels}
    }
    ends = {other: (usual[task], usual[other]) for other in usual}
    outcomes = zip(episodes["label"], cube_outcomes(moved(episodes, "cube")), strict=True)
    return f"{np.mean([outcome not in ends[label] for label, outcome in outcomes]):.0%}"


def method_table(task: str, played: Mapping[str, Episodes]) -> Table:
    """Behaviour of every method, one line each."""
    group = min(GROUP, len(played["prototype"]["eef"]))
    known = {tuple(cell) for cell in occupied_cells(moved(played["tasks"], "eef"), CELL)}
    lines = []
    for name, episodes in played.items():
        eef = moved(episodes, "eef")
        cells = {tuple(cell) for cell in occupied_cells(eef, CELL)}
        if name.endswith("_noise"):
            title = f"Action noise, as far as: {METHODS[name.removesuffix('_noise')].lower()}"
        else:
            title = METHODS[name]
        line = [title, str(len(eef)), f"{episodes['deviation'].mean():.2f}"]
        line += [with_interval(group_coverage(eef, CELL, group_size=group), ".0f")]
        line += [str(len(cells)), str(len(cells - known)), f"{spread(eef[:, -1]):.3f}"]
        line += [with_interval(mean_speed(eef, 1 / CONTROL_FREQUENCY), ".3f")]
        if task != "reach":
            displacement = moved(episodes, "cube")
            covered = group_coverage(displacement, CELL, group_size=group)
            outcomes = cube_outcomes(displacement)
            shares = {kind: outcomes.count(kind) / len(outcomes) for kind in CUBE_OUTCOMES}
            line += [with_interval(covered, ".0f"), f"{1 - shares['still']:.0%}"]
            line += [f"{effective_number(outcomes):.1f}"]
            between = name in ("straight", "curve", "curve_moving")
            line += [share_of_neither(task, episodes, played["tasks"]) if between else MISSING]
            line += [", ".join(f"{kind} {x:.0%}" for kind, x in shares.items() if x)]
        else:
            line += [MISSING] * 5
        lines.append(line)
    return Table(
        title=f"Interpolation as exploration, in the scene of {task}",
        caption=(
            "Size: mean norm of the executed action minus the policy's at the scene's prototype "
            f"in the same state, from the same proposals. Cells: of {CELL * 100:.0f} cm, of "
            f"positions relative to the episode's start; “cells of {group}” are those that "
            f"{group} episodes occupy together. New: cells of all episodes in which no episode of "
            "any task's prototype was. Spread: root mean square distance of the final "
            "end-effector positions from their mean. Kinds: effective number of outcomes, of what "
            f"may become of the cube: {', '.join(CUBE_OUTCOMES)}. Neither: episodes with an "
            "outcome that is usual at neither end of their path. "
            "Brackets: 95% bootstrap intervals over episodes, or over groups."
        ),
        header=(
            "Method", "Episodes", "Size", f"Cells of {group}", "Cells of all", "New",
            "Spread [m]", "Speed [m/s]", f"Cube's cells of {group}", "Cube moved", "Kinds",
            "Neither", "Outcomes",
        ),
        rows=lines,
    )  # fmt: skip


def switching_table(played: Mapping[str, Episodes]) -> Table:
    """Whether reach episodes arrive, with and without a switch."""
    lines = []
    for name, episodes in played.items():
        success = episodes["success"].astype(bool)
        leaving = episodes["label"].astype(int)
        early = [success[i, : leaving[i]].any() for i in range(len(success))]
        apart = np.linalg.norm(episodes["eef"] - played["stay"]["eef"], axis=-1)
        first = success.argmax(1)[success.any(1)] / CONTROL_FREQUENCY
        lines.append(
            [
                SWITCHES[name],
                str(len(success)),
                with_interval(success.any(1).astype(float), ".2f"),
                with_interval(success[:, -1].astype(float), ".2f"),
                str(sum(early)),
                f"{np.median(first):.2f}" if len(first) else MISSING,
                f"{apart.max(1).mean():.4f}",
            ]
        )
    return Table(
        title="From one reach trajectory to another",
        caption=(
            "Reach episodes from new starts to new goals, driven by the embeddings of held-out "
            f"demonstrations; halfway to the first one's success m goes in {SWITCH_STEPS} steps "
            "along a straight line to the second one's. Arrived: within 2 cm of the episode's own "
            "goal at some step; there: at the last one. Apart: the end-effector's largest distance "
            "from where it is without leaving, mean over episodes; where that is next to nothing, "
            "two demonstrations are one behaviour. Brackets: 95% bootstrap intervals."
        ),
        header=(
            "m", "Episodes", "Arrived", "There at the end", "Arrived before", "After [s]",
            "Apart [m]",
        ),
        rows=lines,
    )  # fmt: skip


def make_pictures(
    played: Mapping[str, Episodes],
    embeddings: Mapping[str, np.ndarray],
    paths: Mapping[str, Sequence[np.ndarray]],
    random: np.ndarray,
) -> dict[str, Picture]:
    """The two figures by the name of their file.

    Args:
        played: episodes of every method.
        embeddings: of training transitions by task, ``(N, m)``.
        paths: by kind, from the scene's prototype to every other, ``(T, m)``.
        random: points of the embedding, ``(N, m)``.
    """
    shown = ["prototype", "tasks", "straight", "straight_noise", "curve", "random"]
    trajectories = behaviour_trajectories(
        {name.replace("_", " "): moved(played[name], "eef") for name in shown},
        {name.replace("_", " "): played[name]["along"] for name in shown},
    )
    points = list(embeddings.values())
    index = np.repeat(np.arange(len(points)), list(map(len, points)))
    titles = list(map(task_name, embeddings))
    drawn = embedding_paths(np.concatenate(points), index, titles, paths, random)
    return {
        "interpolation_trajectories": Picture(
            png=trajectories,
            alt="Ways of the end-effector, one panel per method",
            caption=(
                "Ways of the end-effector from its start, seen from above and from behind; the "
                "colour says where on its path between two tasks an episode's m lies."
            ),
        ),
        "interpolation_paths": Picture(
            png=drawn,
            alt="Embeddings by task, with lines and curves between the tasks' prototypes",
            caption=(
                "Where the episodes' m lie: straight lines, curves over the training transitions, "
                "and random points of the embedding."
            ),
        ),
    }
