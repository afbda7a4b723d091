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
from pages import TITLES
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
    table = stages_table(rows_of_page(), TITLES)
    compared = {(line[0].partition(" (")[0], line[1].partition(" (")[0]) for line in table.rows}
    algorithms = ("BC", "BC, best episodes", "IQL", "TD3+BC", "ReBRAC")
    assert compared == {(policy, name) for policy in ("BCQ", "Distilled") for name in algorithms}
    for line in table.rows:
        assert float(line[2].partition("[")[2].partition(",")[0]) > 0.0, line


def test_the_differences_on_the_page_of_baselines_are_those_of_the_published_runs() -> None:
    lines = stages_table(rows_of_page(), TITLES).rows
    shares = {
        line[1]: f"{float(line[2].partition('%')[0]):.0f}%" for line in lines if line[0] == "BCQ"
    }
    text = " ".join((DOCS / "baselines.md").read_text(encoding="utf-8").split())
    assert (
        f"the differences are {shares['BC']} to BC, "
        f"{shares['BC, best episodes (share 0.5)']} to BC of the best episodes, "
        f"{shares['IQL']} to IQL, {shares['IQL (expectile 0.5)']} to IQL with tuned coefficients"
    ) in text
    assert (
        f"{shares['TD3+BC (alpha 1)']} to TD3+BC and "
        f"{shares['ReBRAC (actor_penalty 0.3)']} to ReBRAC"
    ) in text


def test_both_stages_are_compared_with_every_other_algorithm_start_by_start() -> None:
    rows = make_weak_rows(shares={(("bcq", ""), "reach"): 1.9})

    def returns(policy: str) -> np.ndarray:
        mine = [r for r in rows if (r.policy, r.task) == (policy, "reach")]
        return np.array([r.episode_return for r in mine])

    table = stages_table(rows, TITLES)
    assert [line[:2] for line in table.rows] == [
        (policy, other) for other in ("BC", "IQL") for policy in ("BCQ", "Distilled (prototype)")
    ]
    column = table.header.index(TITLES["reach"])
    for line, other in zip(table.rows[::2], ("bc", "iql"), strict=True):
        share = (returns("bcq").mean() - returns(other).mean()) / returns("expert").mean()
        assert line[column].startswith(f"{share:+.1%} [")
    assert "### Both stages minus each other algorithm" in make_weak_page(make_weak()).text
    assert not stages_table([r for r in rows if r.policy not in ("bc", "iql")], TITLES).rows
