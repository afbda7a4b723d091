"""Tables and figures of the interpolation study; ``docs/interpolation.md`` explains them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

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
from torchrl_bmrl.reports import Picture, Table, behaviour_trajectories, embedding_paths
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
"""Titles of the methods: where m comes from, or the action."""
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
    """Positions relative to each episode's start, because starts are not behaviour."""
    return episodes[name] - episodes[name][:, :1]


def with_interval(values: np.ndarray, form: str) -> str:
    """Mean and its bootstrap interval."""
    low, high = bootstrap_interval(values)
    return f"{values.mean():{form}} [{low:{form}}, {high:{form}}]"


def share_of_neither(task: str, episodes: Episodes, tasks: Episodes) -> str:
    """Share of episodes whose outcome is usual at neither end of the episode's path."""
    labels = list(zip(tasks["label"], cube_outcomes(moved(tasks, "cube")), strict=True))
    usual = {
        other: Counter(outcome for label, outcome in labels if label == other).most_common(1)[0][0]
        for other in {label for label, _ in labels}
    }
    outcomes = zip(episodes["label"], cube_outcomes(moved(episodes, "cube")), strict=True)
    neither = [outcome not in (usual.get(task), usual.get(label)) for label, outcome in outcomes]
    return f"{np.mean(neither):.0%}"


def method_table(task: str, played: Mapping[str, Episodes], frequency: float) -> Table:
    """Behaviour of every method, one line each; nothing of a cube that no episode moves."""
    group = min(GROUP, len(played["prototype"]["eef"]))
    known = {tuple(cell) for cell in occupied_cells(moved(played["tasks"], "eef"), CELL)}
    has_cube = any(moved(episodes, "cube").any() for episodes in played.values())
    lines = []
    for name, episodes in played.items():
        eef, cube = moved(episodes, "eef"), moved(episodes, "cube")
        cells = {tuple(cell) for cell in occupied_cells(eef, CELL)}
        title = METHODS[name.removesuffix("_noise")]
        if name.endswith("_noise"):
            title = f"Action noise, as far as: {title.lower()}"
        line = [title, str(len(eef)), f"{episodes['deviation'].mean():.2f}"]
        line += [with_interval(group_coverage(eef, CELL, group_size=group), ".0f")]
        line += [str(len(cells)), str(len(cells - known)), f"{spread(eef[:, -1]):.3f}"]
        line += [with_interval(mean_speed(eef, 1 / frequency), ".3f")]
        if has_cube:
            outcomes = cube_outcomes(cube)
            shares = {kind: outcomes.count(kind) / len(outcomes) for kind in CUBE_OUTCOMES}
            line += [with_interval(group_coverage(cube, CELL, group_size=group), ".0f")]
            line += [f"{1 - shares['still']:.0%}", f"{effective_number(outcomes):.1f}"]
            between = name in ("straight", "curve", "curve_moving")
            line += [share_of_neither(task, episodes, played["tasks"]) if between else MISSING]
            line += [", ".join(f"{kind} {x:.0%}" for kind, x in shares.items() if x)]
        lines.append(line if has_cube else [*line, *[MISSING] * 5])
    return Table(
        title=f"Interpolation as exploration, in the scene of {task}",
        caption=(
            "Size: mean norm of the difference between the executed action and the policy's at "
            "the scene's prototype, in the same state with the same proposals. Cells: of "
            f"{CELL * 100:.0f} cm, of positions relative to the episode's start; “cells of "
            f"{group}” are those that {group} episodes occupy together. New: cells of all episodes "
            "that no episode of a task's prototype occupies. Spread: root mean square distance of "
            "the final end-effector positions from their mean. Kinds: effective number of the "
            f"cube's outcomes, which are {', '.join(CUBE_OUTCOMES)}. Neither: episodes with an "
            "outcome that is usual at neither end of their path. Brackets: 95% bootstrap "
            "intervals over episodes, or over groups."
        ),
        header=(
            "Method", "Episodes", "Size", f"Cells of {group}", "Cells of all", "New",
            "Spread [m]", "Speed [m/s]", f"Cube's cells of {group}", "Cube moved", "Kinds",
            "Neither", "Outcomes",
        ),
        rows=lines,
    )  # fmt: skip


def switching_table(title: str, played: Mapping[str, Episodes], frequency: float) -> Table:
    """Whether episodes of a task succeed, with and without a switch."""
    lines = []
    for name, episodes in played.items():
        success = episodes["success"].astype(bool)
        leaving = episodes["label"].astype(int)
        early = sum(success[i, : leaving[i]].any() for i in range(len(success)))
        apart = np.linalg.norm(episodes["eef"] - played["stay"]["eef"], axis=-1)
        first = (success.argmax(1)[success.any(1)] + 1) / frequency  # after the step that succeeds
        line = [SWITCHES[name], str(len(success))]
        line += [with_interval(x.astype(float), ".2f") for x in (success.any(1), success[:, -1])]
        line += [str(early), f"{np.median(first):.2f}" if len(first) else MISSING]
        lines.append([*line, f"{apart.max(1).mean():.4f}"])
    return Table(
        title=f"From one {title.lower()} trajectory to another",
        caption=(
            f"{title} episodes from new starts to new goals, driven by the embeddings of held-out "
            "demonstrations. Halfway to the first one's success m moves to the second one's in "
            f"{SWITCH_STEPS} steps along a straight line. Arrived: the task succeeds at some step; "
            "there: at the last one. Apart: the end-effector's largest distance from its position "
            "without a switch, mean over episodes; if it is close to zero, two demonstrations are "
            "one behaviour. Brackets: 95% bootstrap intervals."
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
    """The two figures by file name.

    Args:
        played: episodes of every method.
        embeddings: of training transitions by the task's title, ``(N, m)``.
        paths: by kind, from the scene's prototype to every other one, ``(T, m)``.
        random: points of the embedding, ``(N, m)``.
    """
    shown = ["prototype", "tasks", "straight", "straight_noise", "curve", "random"]
    trajectories = behaviour_trajectories(
        {name.replace("_", " "): moved(played[name], "eef") for name in shown},
        {name.replace("_", " "): played[name]["along"] for name in shown},
    )
    points = list(embeddings.values())
    index = np.repeat(np.arange(len(points)), list(map(len, points)))
    drawn = embedding_paths(np.concatenate(points), index, list(embeddings), paths, random)
    return {
        "interpolation_trajectories": Picture(
            png=trajectories,
            alt="Trajectories of the end-effector, one panel per method",
            caption=(
                "Trajectories of the end-effector from its start, from above and from behind. The "
                "colour is the position of an episode's m on its path between two tasks."
            ),
        ),
        "interpolation_paths": Picture(
            png=drawn,
            alt="Embeddings by task, with lines and curves between the tasks' prototypes",
            caption=(
                "The episodes' m: straight lines, curves over the training transitions, and random "
                "points of the embedding."
            ),
        ),
    }
