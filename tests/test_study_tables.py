"""The tables of the studies, from rows made by hand, and what the perturbations perturb."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from torchrl_bmrl.evaluation import ResultRow
from torchrl_bmrl.reports.tables import MISSING
from torchrl_bmrl.studies import baselines, imitation, interpolation_report, people
from torchrl_bmrl.studies.imitation import ImitateSettings

IMITATE = ImitateSettings(
    composition="reach-lift", demonstrations=2, episodes=4, magnitude=(0.5, 2.0), max_angle=30.0
)


def test_imitation_counts_the_tasks_done_and_resamples_within_each_demonstration() -> None:
    # Each demonstration decides its episodes, so that resampling within it moves nothing.
    stages = {0: (2, 2), 1: (1, 0)}
    rows = [
        {
            "method": method,
            "perturbation": perturbation,
            "demonstration": demonstration,
            "stages": done,
            "success": int(done == 2),
        }
        for method in imitation.METHODS
        for perturbation in imitation.PERTURBATIONS
        for demonstration, each in stages.items()
        for done in each
    ]
    table = imitation.make_table(IMITATE, ["Reach", "Lift"], rows)
    assert table.header[2:4] == ("1. Reach", "2. Lift")
    assert len(table.rows) == len(imitation.METHODS) * len(imitation.PERTURBATIONS)
    for line in table.rows:
        assert list(line[2:]) == ["75%", "50%", "50%", "[50%, 50%]", "4"]
    unknown = imitation.make_table(IMITATE, ["Reach", "Lift"], [r | {"success": ""} for r in rows])
    assert all(list(line[4:6]) == [MISSING, MISSING] for line in unknown.rows)


@pytest.mark.parametrize(
    ("name", "magnitude", "angle", "per"),
    [
        ("magnitude", (0.5, 2.0), 0.0, "step"),
        ("direction", (1.0, 1.0), 30.0, "step"),
        ("both", (0.5, 2.0), 30.0, "step"),
        ("both, constant", (0.5, 2.0), 30.0, "episode"),
    ],
)
def test_a_perturbation_changes_what_its_name_says(
    name: str, magnitude: tuple[float, float], angle: float, per: str
) -> None:
    (transform,) = imitation.make_perturbation(IMITATE, name)
    assert tuple(transform.magnitude) == magnitude
    assert transform.max_angle == pytest.approx(math.radians(angle))
    assert transform.per == per
    assert imitation.make_perturbation(IMITATE, "none") == []


def test_human_data_is_judged_within_each_training_seed() -> None:
    # Two trainings differ, and the episodes of each agree: resampling within them moves nothing.
    rows: list[dict[str, Any]] = [
        {"share": share, "training_seed": seed, "return": 100.0 + gain[seed], "success": 1}
        for share, gain in ((0.0, (0, 0)), (0.2, (9, -7)))
        for seed in (0, 1)
        for _ in range(10)
    ]
    table = people.make_table(rows, "Lift")
    assert table.rows[1][3:] == ("+1.0", "+1.0 to +1.0", "helped")


def test_switching_tells_arriving_from_staying_and_counts_arrivals_before_the_switch() -> None:
    success = np.array([[0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]], dtype=float)
    eef = np.zeros((3, 4, 3))
    episodes = {"success": success, "label": np.array(["2", "2", "2"]), "eef": eef}
    moved = eef.copy()
    moved[:, 2, 0] = 0.3  # the farthest step counts, not the last one
    played = {"stay": episodes, "switch": episodes | {"eef": moved}}
    stay, switch = interpolation_report.switching_table("Reach", played, 20.0).rows
    assert [cell.split()[0] for cell in stay[2:4]] == ["0.67", "0.33"]
    assert list(stay[4:]) == ["1", "0.15", "0.0000"]
    assert switch[-1] == "0.3000"


def test_baselines_stand_in_the_runs_order_of_tasks() -> None:
    rows = [
        ResultRow(task=task, policy="bc", seed=0, episode=0, episode_return=value, success=True)
        for task, value in (("lift", 5.0), ("pour", 7.0))
    ]
    titles = {"stack": "Stacking", "pour": "Pouring", "lift": "Lifting"}
    table = baselines.make_table(rows, 10, titles)
    assert table.header[1:3] == ("Pouring", "Lifting")  # nothing of a task without episodes
    assert list(table.rows[0][1:3]) == ["7.0, 100%", "5.0, 100%"]
