"""Measures of how well the embedding shows the stages and the distance to the goal."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from report_data import TASKS, cells, make_known

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.embedding import STAGE_TAIL
from torchrl_bmrl.reports import (
    Embeddings,
    goal_distance_table,
    measure_goal_distance,
    measure_stages,
    stages_table,
)


def test_embeddings_refuse_what_does_not_fit() -> None:
    zeros = np.zeros(3, dtype=int)
    fits: dict[str, Any] = {
        "tasks": ["reach"],
        "task_latent": np.zeros((3, 2)),
        "task": zeros,
        "episode": zeros,
        "step": zeros,
        "distance": np.zeros(3),
    }
    for name, value in (
        ("task_latent", np.zeros(3)),
        ("task_latent", np.full((3, 2), np.nan)),
        ("task", zeros + 1),
        ("step", np.zeros(4, dtype=int)),
        ("distance", np.full(3, np.inf)),
        ("success", np.zeros((3, 1), dtype=bool)),
        ("baselines", {"raw": np.zeros((2, 5))}),
        ("phase_names", {"reach": ()}),
    ):
        message = {"baselines": "raw", "phase_names": r"phase contains \[0\] for reach"}
        with pytest.raises(BMRLError, match=message.get(name, name)):
            Embeddings(**{**fits, name: value})


@pytest.mark.parametrize("dim", [2, 5])
def test_stages_and_distances_that_are_there_are_found(dim: int) -> None:
    training, held_out = make_known(dim), make_known(dim, seed=0)
    stages = measure_stages(training, held_out)
    assert [r.task for r in stages] == [t for t in TASKS if t != "reach"]
    for result in stages:
        # Three episodes of eight steps: success is at step 6, and the steps after it count too.
        assert (result.episodes, result.transitions) == (3, 24)
        assert result.agreement["embedding"].value > result.agreement["raw transition"].value
    distances = measure_goal_distance(training, held_out)
    assert [r.task for r in distances] == list(TASKS)
    for result in distances:
        assert result.correlation["embedding"].value > 0.95
        assert abs(result.correlation["raw transition"].value) < 0.9
        assert result.lowest <= result.correlation["embedding"].value
        assert result.spread is not None
        assert result.spread.value == 0.0


def test_what_happens_after_success_changes_no_number() -> None:
    data = make_known()
    after = data.step > 6
    noise = np.random.default_rng(0).normal(size=data.task_latent.shape)
    moved = replace(
        data,
        task_latent=np.where(after[:, None], noise, data.task_latent),
        phase=np.where(after, 0, data.phase),
        distance=np.where(after, 9.0, data.distance),
    )
    assert measure_goal_distance(moved, moved) == measure_goal_distance(data, data)
    sooner = replace(data, success=data.step >= 3)
    assert measure_goal_distance(data, sooner) != measure_goal_distance(data, data)
    # Stages are measured up to STAGE_TAIL steps after success.
    late = [replace(x, step=np.where(after, x.step + STAGE_TAIL, x.step)) for x in (data, moved)]
    assert measure_stages(late[0], late[0]) == measure_stages(late[1], late[1])
    assert measure_stages(data, data) != measure_stages(moved, moved)


def test_groups_are_found_in_training_data_alone() -> None:
    data = make_known()
    only_one = data.rows(data.episode == 0)
    alone = {r.task: r for r in measure_stages(data, only_one)}
    # If the groups came from the measured data, other training data would change nothing.
    other = replace(data, task_latent=np.random.default_rng(1).normal(size=data.task_latent.shape))
    assert any(r.agreement != alone[r.task].agreement for r in measure_stages(other, only_one))


def test_the_tables_hold_what_was_measured() -> None:
    data = make_known()
    stages, distances = measure_stages(data, data), measure_goal_distance(data, data)
    for result, line in zip(stages, cells(stages_table(stages)), strict=True):
        assert line["Phases"] == "descend, grasp, lift"
        assert line["Embedding"] == str(result.agreement["embedding"])
        assert line["Raw transition"] == str(result.agreement["raw transition"])
        assert (line["Episodes"], line["Transitions"]) == ("3", "24")
    for result, line in zip(distances, cells(goal_distance_table(distances)), strict=True):
        assert line["Embedding"] == str(result.correlation["embedding"])
        assert line["Lowest episode"] == f"{result.lowest:.2f}"
        assert line["Spread, success over start"] == str(result.spread)
