"""Differences of policies on the same starts, as shares of the expert's return."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("matplotlib")

from helpers import refused

from torchrl_bmrl.evaluation import ResultRow, paired_difference
from torchrl_bmrl.studies.baselines_report import make_paired_table

OURS, THEIRS = ("td3_bc", ""), ("bc", "")


def rows_of(policy: str, *returns: float, task: str = "lift", seed: int = 0) -> list[ResultRow]:
    return [
        ResultRow(
            task=task,
            policy=policy,
            seed=seed,
            episode=episode,
            episode_return=value,
            success=True,
        )
        for episode, value in enumerate(returns)
    ]


def test_the_difference_is_a_share_of_the_experts_mean_return_of_the_task() -> None:
    rows = rows_of("td3_bc", 6.0, 9.0) + rows_of("bc", 5.0, 6.0) + rows_of("expert", 15.0, 25.0)
    found = paired_difference(rows, OURS, THEIRS, ["lift"])
    assert found is not None
    assert found.value == pytest.approx((1 + 3) / 2 / 20)
    assert found.low == pytest.approx(1 / 20)
    assert found.high == pytest.approx(3 / 20)


def test_every_task_counts_the_same_whatever_its_episodes_and_returns() -> None:
    rows = rows_of("td3_bc", 2.0) + rows_of("bc", 1.0) + rows_of("expert", 10.0)
    for policy, value in (("td3_bc", 300.0), ("bc", 400.0), ("expert", 1000.0)):
        rows += rows_of(policy, *[value] * 5, task="pour")
    found = paired_difference(rows, OURS, THEIRS, ["lift", "pour"])
    assert found is not None
    assert found.value == pytest.approx((0.1 - 0.1) / 2)


def test_a_difficult_start_does_not_count_as_a_difference() -> None:
    easy = np.random.default_rng(0).uniform(0, 100, 20)
    rows = rows_of("bc", *easy) + rows_of("td3_bc", *(easy + 1.0)) + rows_of("expert", 100.0)
    found = paired_difference(rows, OURS, THEIRS, ["lift"])
    assert found is not None
    assert found.low == pytest.approx(0.01)
    assert found.high == pytest.approx(0.01)


def test_pairs_of_different_training_seeds_are_never_mixed() -> None:
    rows = rows_of("expert", 10.0)
    for seed, gain in ((1, 1.0), (2, 3.0)):  # each constant: nothing to resample within a seed
        rows += rows_of("bc", 10.0 * seed, 20.0 * seed, seed=seed)
        rows += rows_of("td3_bc", 10.0 * seed + gain, 20.0 * seed + gain, seed=seed)
    found = paired_difference(rows, OURS, THEIRS, ["lift"])
    assert found is not None
    assert (found.value, found.low, found.high) == pytest.approx((0.2, 0.2, 0.2))


def test_the_order_of_the_rows_changes_nothing() -> None:
    generator = np.random.default_rng(0)
    rows = [
        row
        for policy in ("td3_bc", "bc", "expert")
        for task in ("lift", "pour")
        for seed in (1, 2)
        for row in rows_of(policy, *generator.uniform(1, 9, 6), task=task, seed=seed)
    ]
    shuffled = [rows[i] for i in generator.permutation(len(rows))]
    tasks = ["lift", "pour"]
    found = paired_difference(rows, OURS, THEIRS, tasks)
    assert found is not None
    assert paired_difference(shuffled, OURS, THEIRS, tasks) == found


def test_only_starts_that_both_policies_have_count() -> None:
    rows = rows_of("td3_bc", 2.0, 100.0) + rows_of("bc", 1.0) + rows_of("expert", 10.0)
    found = paired_difference(rows, OURS, THEIRS, ["lift"])
    assert found is not None
    assert found.value == pytest.approx(0.1)


@pytest.mark.parametrize("expert", [[], [0.0], [-5.0]])
def test_without_a_positive_return_of_the_expert_there_is_no_difference(
    expert: list[float],
) -> None:
    rows = rows_of("td3_bc", 2.0) + rows_of("bc", 1.0) + rows_of("expert", *expert)
    assert paired_difference(rows, OURS, THEIRS, ["lift"]) is None


def test_without_a_shared_start_on_one_task_there_is_no_mean_over_tasks() -> None:
    rows = rows_of("td3_bc", 2.0) + rows_of("bc", 1.0) + rows_of("expert", 10.0)
    rows += rows_of("td3_bc", 2.0, task="pour") + rows_of("expert", 10.0, task="pour")
    assert paired_difference(rows, OURS, THEIRS, ["lift"]) is not None
    assert paired_difference(rows, OURS, THEIRS, ["lift", "pour"]) is None


def test_two_runs_with_the_same_seed_are_refused() -> None:
    rows = 2 * rows_of("td3_bc", 2.0) + rows_of("bc", 1.0) + rows_of("expert", 10.0)
    with refused("td3_bc has two episodes 0 of lift with seed 0; valid: runs with different seeds"):
        paired_difference(rows, OURS, THEIRS, ["lift"])


def test_the_table_compares_each_policy_with_each_reference_but_none_with_itself() -> None:
    rows = rows_of("expert", 10.0)
    for policy, value in (("bc", 4.0), ("iql", 5.0), ("bcq", 6.0)):
        rows += rows_of(policy, value, value)
    table = make_paired_table(rows, {"lift": "Lifting"})
    assert table.header == ("Policy", "Reference", "Mean over tasks", "Lifting")
    assert [row[:3] for row in table.rows] == [
        ("BCQ", "BC", "+20.0% [+20.0, +20.0]"),
        ("IQL", "BC", "+10.0% [+10.0, +10.0]"),
        ("BCQ", "IQL", "+10.0% [+10.0, +10.0]"),
        ("BC", "IQL", "-10.0% [-10.0, -10.0]"),
    ]
    assert make_paired_table(rows_of("bcq", 1.0), {}).rows == []
