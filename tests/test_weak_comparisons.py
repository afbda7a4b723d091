"""Both stages beside other algorithms on weak demonstrations, on the page and in README."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from published_data import DOCS
from weak_data import make_weak, make_weak_rows

# isort: split
from published import TASKS, WEAK, read_published
from weak_page import make_weak_page
from weak_tables import stages_table

from torchrl_bmrl.evaluation import ResultRow


def rows_of_page() -> list[ResultRow]:
    """The published episodes of the main runs."""
    published = read_published(DOCS / "results" / "weak")
    return [episode.row for episode in published.episodes if episode.key[:2] == WEAK]


def readme() -> str:
    return " ".join((DOCS.parent / "README.md").read_text(encoding="utf-8").split())


def test_the_readmes_gains_over_the_demonstrators_are_those_of_the_published_runs() -> None:
    rows = rows_of_page()

    def mean(task: str, policy: str) -> float:
        chosen = [r.episode_return for r in rows if (r.task, r.policy) == (task, policy)]
        return float(np.mean(chosen))

    for policy, words in (
        ("bcq", "the BCQ policies return {} times as much as their demonstrators"),
        ("distilled", "the distilled policy {} times"),
    ):
        gains = sorted(mean(task, policy) / mean(task, "expert") for task in TASKS)
        assert words.format(f"{gains[0]:.2f} to {gains[-1]:.2f}") in readme()


def test_the_readmes_algorithms_return_less_on_the_mean_over_tasks() -> None:
    assert "both return more than BC, IQL, TD3+BC and ReBRAC do" in readme()
    table = stages_table(rows_of_page())
    for policy in ("BCQ", "Distilled"):
        lines = {line[1].partition(" (")[0]: line[2] for line in table.rows if line[0] == policy}
        for name in ("BC", "IQL", "TD3+BC", "ReBRAC"):
            assert float(lines[name].partition("[")[2].partition(",")[0]) > 0.0


def test_both_stages_are_compared_with_every_other_algorithm_start_by_start() -> None:
    rows = make_weak_rows(shares={(("bcq", ""), "reach"): 1.9})

    def returns(policy: str) -> np.ndarray:
        mine = [r for r in rows if (r.policy, r.task) == (policy, "reach")]
        return np.array([r.episode_return for r in mine])

    table = stages_table(rows)
    assert [line[:2] for line in table.rows] == [
        (policy, other) for policy in ("BCQ", "Distilled") for other in ("BC", "IQL")
    ]
    column = table.header.index("Reach")
    for line, other in zip(table.rows, ("bc", "iql"), strict=False):
        share = (returns("bcq").mean() - returns(other).mean()) / returns("expert").mean()
        assert line[column].startswith(f"{share:+.1%} [")
    assert "### Both stages less each other algorithm" in make_weak_page(make_weak()).text
    assert not stages_table([row for row in rows if row.policy not in ("bc", "iql")]).rows
