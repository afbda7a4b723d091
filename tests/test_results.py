"""results.csv keeps every bit and refuses what it does not understand."""

from __future__ import annotations

import csv
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.evaluation.results import (
    RESULT_FIELDS,
    ResultRow,
    read_results,
    summarise,
    write_results,
)
from torchrl_bmrl.evaluation.statistics import bootstrap_interval

TASKS = ("reach", "lift", "push_right", "push_left", "push_up", "push_down")
ROW = ResultRow(task="lift", policy="bcq", seed=1, episode=2, episode_return=3.5, success=True)
LINE = {
    "task": "reach",
    "policy": "distilled",
    "latent_source": "online",
    "seed": "0",
    "episode": "7",
    "return": "12.5",
    "success": "1",
}


def written(path: Path, *lines: dict[str, str]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, lines[0])
        writer.writeheader()
        writer.writerows(lines)
    return path


def sample_rows() -> list[ResultRow]:
    rng = np.random.default_rng(0)
    return [
        ResultRow(
            task=task,
            policy=policy,
            latent_source=source,
            seed=seed,
            episode=episode,
            episode_return=float(rng.normal(200, 30)),
            success=bool(rng.random() < 0.7),
        )
        for task in ("push_up", "reach")
        for policy, source in (("distilled", "prototype"), ("distilled", "online"), ("bcq", ""))
        for seed in (0, 3)
        for episode in range(6)
    ]


def test_reading_gives_the_written_rows_bit_by_bit(tmp_path: Path) -> None:
    awkward = [0.1 + 0.2, 1 / 3, 5e-324, -0.0, 1.7976931348623157e308, 1e22]
    rows = [replace(ROW, episode=i, episode_return=r) for i, r in enumerate(awkward)]
    rows += [replace(ROW, policy="distilled", latent_source="online", success=False)]
    write_results(tmp_path / "results.csv", rows)
    read = read_results(tmp_path / "results.csv")
    assert read == rows
    assert [r.episode_return.hex() for r in read] == [float(r.episode_return).hex() for r in rows]


def test_numpy_values_are_written_as_plain_numbers(tmp_path: Path) -> None:
    values: dict[str, Any] = {
        "seed": np.int64(4),
        "episode_return": np.float64(0.1),
        "success": np.bool_(True),
    }
    write_results(tmp_path / "results.csv", [replace(ROW, **values)])
    text = (tmp_path / "results.csv").read_text()
    assert text.splitlines() == [",".join(RESULT_FIELDS), "lift,bcq,,4,2,0.1,1"]


def test_columns_are_those_of_the_format(tmp_path: Path) -> None:
    assert read_results(written(tmp_path / "results.csv", {**LINE, "note": "ignored"})) == [
        ResultRow(
            task="reach",
            policy="distilled",
            latent_source="online",
            seed=0,
            episode=7,
            episode_return=12.5,
            success=True,
        )
    ]


@pytest.mark.parametrize(
    ("column", "value", "valid"),
    [
        ("task", "", "a name"),
        ("policy", "", "a name"),
        ("latent_source", "", "a source's name"),
        ("seed", "zero", "whole number"),
        ("episode", "1.5", "whole number"),
        ("return", "nan", "finite number"),
        ("return", "inf", "finite number"),
        ("return", "much", "finite number"),
        ("success", "True", "0, 1, or nothing if unknown"),
    ],
)
def test_a_bad_value_is_named_with_file_line_and_column(
    tmp_path: Path, column: str, value: str, valid: str
) -> None:
    path = written(tmp_path / "results.csv", LINE, {**LINE, column: value})
    with pytest.raises(DataError) as caught:
        read_results(path)
    for part in (str(path), "line 3", column, repr(value), valid):
        assert part in str(caught.value)


def test_an_episode_is_not_counted_twice(tmp_path: Path) -> None:
    path = written(
        tmp_path / "results.csv", LINE, {**LINE, "episode": "8"}, {**LINE, "return": "9"}
    )
    with pytest.raises(DataError) as caught:
        read_results(path)
    for part in (str(path), "line 4", "episode", "of line 2"):
        assert part in str(caught.value)


@pytest.mark.parametrize("number", [1.5e308, 1e200, float("inf"), float("nan")])
def test_returns_without_a_finite_mean_and_deviation_are_not_averaged(number: float) -> None:
    rows = [replace(ROW, episode=i, episode_return=number * (i > 0)) for i in range(3)]
    with pytest.raises(BMRLError, match=r"policy .* on .*: .*mean.*valid: finite"):
        summarise(rows)


def test_a_column_that_adds_up_to_infinity_is_refused_by_name(tmp_path: Path) -> None:
    lines = [{**LINE, "episode": str(i), "return": "1.5e308"} for i in range(2)]
    read_results(written(tmp_path / "one.csv", lines[0]))
    with pytest.raises(DataError, match=r"two\.csv: return: its values add up to infinity"):
        read_results(written(tmp_path / "two.csv", *lines))


def test_a_byte_order_mark_hides_no_column(tmp_path: Path) -> None:
    path = written(tmp_path / "results.csv", LINE)
    rows = read_results(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_results(path) == rows


def test_a_source_is_refused_where_the_policy_has_none(tmp_path: Path) -> None:
    path = written(tmp_path / "results.csv", {**LINE, "policy": "bcq"})
    with pytest.raises(DataError, match=r"latent_source.*'online'.*nothing for policy bcq"):
        read_results(path)


def test_a_truncated_line_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "results.csv", LINE)
    path.write_text(path.read_text() + "reach,bcq,,0")
    with pytest.raises(DataError, match=r"line 3.* is missing"):
        read_results(path)


@pytest.mark.parametrize("column", RESULT_FIELDS)
def test_a_missing_column_is_named(tmp_path: Path, column: str) -> None:
    path = written(tmp_path / "results.csv", {k: v for k, v in LINE.items() if k != column})
    with pytest.raises(DataError, match=f"results.csv: {column}: column is missing"):
        read_results(path)


def test_a_missing_or_empty_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.csv: no such file"):
        read_results(tmp_path / "nowhere.csv")
    (tmp_path / "empty.csv").touch()
    with pytest.raises(DataError, match=r"empty\.csv: task: column is missing"):
        read_results(tmp_path / "empty.csv")


def test_a_row_that_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    write_results(path, [ROW])
    with pytest.raises(DataError, match="return"):
        write_results(path, [ROW, replace(ROW, episode_return=float("nan"))])
    assert read_results(path) == [ROW]
    assert list(tmp_path.iterdir()) == [path]


def test_summaries_are_recomputed_from_the_rows() -> None:
    pytest.importorskip("scipy")
    rows = sample_rows()
    for summary in summarise(rows):
        mine = [
            r
            for r in rows
            if (r.task, r.policy, r.latent_source)
            == (summary.task, summary.policy, summary.latent_source)
        ]
        returns = [r.episode_return for r in mine]
        assert summary.episodes == len(mine) == 12
        assert summary.seeds == 2
        assert summary.mean_return == pytest.approx(sum(returns) / 12)
        deviations = [(r - sum(returns) / 12) ** 2 for r in returns]
        assert summary.std_return == pytest.approx((sum(deviations) / 11) ** 0.5)
        assert summary.success_rate == pytest.approx(sum(r.success for r in mine) / 12)
        seeds = [r.seed for r in mine]
        assert summary.return_interval == bootstrap_interval(returns, strata=seeds)
        assert summary.success_interval == bootstrap_interval(
            [float(r.success) for r in mine], strata=seeds
        )


def test_summaries_come_in_the_order_of_the_tables_whatever_the_order_of_rows() -> None:
    pytest.importorskip("scipy")
    rows = [*sample_rows(), *(replace(ROW, task=t, policy="expert") for t in reversed(TASKS))]
    shuffled = random.Random(0).sample(rows, len(rows))
    assert summarise(shuffled, TASKS) == summarise(rows, TASKS)
    order = [(s.task, s.policy, s.latent_source) for s in summarise(shuffled, TASKS)]
    assert list(dict.fromkeys(task for task, _, _ in order)) == list(TASKS)
    assert [rest for task, *rest in order if task == "reach"] == [
        ["expert", ""],
        ["bcq", ""],
        ["distilled", "online"],
        ["distilled", "prototype"],
    ]


def test_tasks_without_an_order_come_as_they_appear_and_policies_after_the_known_ones() -> None:
    pytest.importorskip("scipy")
    names = [("pour", "mine"), ("pour", "bcq"), ("ant", "bcq"), ("pour", "a_study")]
    rows = [replace(ROW, task=task, policy=policy) for task, policy in names]
    assert [(s.task, s.policy) for s in summarise(rows)] == [
        ("pour", "bcq"),
        ("pour", "a_study"),
        ("pour", "mine"),
        ("ant", "bcq"),
    ]
    assert [s.task for s in summarise(rows, ["ant"])] == ["ant", "pour", "pour", "pour"]


def test_an_unknown_success_is_an_empty_cell_and_has_no_rate(tmp_path: Path) -> None:
    pytest.importorskip("scipy")
    rows = [replace(ROW, task="walk", episode=i, success=None) for i in range(3)]
    write_results(tmp_path / "results.csv", rows)
    assert (tmp_path / "results.csv").read_text().splitlines()[1] == "walk,bcq,,1,0,3.5,"
    assert read_results(tmp_path / "results.csv") == rows
    (summary,) = summarise(rows)
    assert (summary.success_rate, summary.success_interval) == (None, None)
    assert summary.mean_return == 3.5


def test_one_episode_has_no_spread() -> None:
    (summary,) = summarise([ROW])
    assert summary.std_return == 0.0
    assert summary.return_interval == (3.5, 3.5)
    assert summary.success_interval == (1.0, 1.0)
