"""The published files keep what they were given and refuse what does not fit together."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from published_data import make_curves, make_published, make_rows, make_run
from weak_data import make_agents, make_weak, make_weak_rows

# isort: split
from published import EpisodeRow, Published, read_curve_rows, read_published, write_published

from torchrl_bmrl.errors import DataError


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    published = make_published()
    write_published(tmp_path, published)
    read = read_published(tmp_path)
    assert set(read.episodes) == set(published.episodes)
    assert set(read.curves) == set(published.curves)
    assert set(read.runs) == set(published.runs)


def test_equal_results_are_equal_files_whatever_their_order(tmp_path: Path) -> None:
    published = make_published()
    write_published(tmp_path / "a", published)
    rng = random.Random(0)
    shuffled = {name: rng.sample(rows, len(rows)) for name, rows in vars(published).items()}
    write_published(tmp_path / "b", Published(**shuffled))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    write_published(tmp_path / "b", read_published(tmp_path / "a"))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_the_papers_preset_comes_first_and_runs_without_a_change_before_others(
    tmp_path: Path,
) -> None:
    keys = [("paper", "none", 1), ("paper", "dim4", 0), ("deep", "none", 0), ("deep", "bc", 0)]
    run = make_run(seed=0)
    runs = [
        replace(run, preset=preset, ablation=ablation, seed=seed)
        for preset, ablation, seed in reversed(keys)
    ]
    episodes = [
        EpisodeRow(preset=preset, ablation=ablation, row=replace(make_rows(seed)[0], seed=seed))
        for preset, ablation, seed in keys
    ]
    write_published(tmp_path, Published(runs=runs, episodes=episodes))
    read = read_published(tmp_path)
    assert [run.key for run in read.runs] == [episode.key for episode in read.episodes] == keys


def test_a_run_replaces_its_rows_and_no_others() -> None:
    published = make_published()
    again = published.with_run(make_run(seed=2), make_rows(2, episodes=3), make_curves(2, epochs=1))
    key = ("paper", "none", 2)
    assert {run.key for run in again.runs} == {run.key for run in published.runs}
    assert len(again.runs) == len(published.runs)
    new = [e.row for e in again.episodes if e.key == key]
    assert new == make_rows(2, episodes=3)
    assert [e for e in again.episodes if e.key != key] == [
        e for e in published.episodes if e.key != key
    ]
    assert [c for c in again.curves if c.seed == 2] == make_curves(2, epochs=1)
    assert [c for c in again.curves if c.seed == 1] == make_curves(1)


def test_the_diagnostics_of_a_run_replace_those_of_the_same_run_alone() -> None:
    published = make_weak()
    new = [replace(make_agents("weak_paper", "none", 2)[0], spread_ratio=0.5)]
    again = published.with_run(make_run("weak_paper", seed=2), make_weak_rows(2), [], new)
    others = [d for d in published.diagnostics if d.seed != 2]
    assert others
    assert list(again.diagnostics) == others + new


def test_diagnostics_are_read_back_and_refused_twice_or_without_a_run(tmp_path: Path) -> None:
    write_published(tmp_path, make_weak())
    assert set(read_published(tmp_path).diagnostics) == set(make_weak().diagnostics)
    path = tmp_path / "diagnostics.csv"
    text = path.read_text()
    first = text.splitlines()[1]
    for line, says in (
        (first, r"diagnostics.csv: line 12 repeats line 2"),
        (first.replace("none,1", "none,7"), r"'weak_paper', 'none', 7.* not in runs"),
    ):
        path.write_text(f"{text}{line}\n")
        with pytest.raises(DataError, match=says):
            read_published(tmp_path)


def test_curves_are_kept_of_the_paper_s_runs_alone() -> None:
    published = Published().with_run(make_run("quick"), make_rows(), make_curves())
    assert published.episodes
    assert not published.curves
    published = published.with_run(make_run(ablation="dim4"), make_rows(), make_curves())
    assert not published.curves


def test_returns_have_three_decimals(tmp_path: Path) -> None:
    rows = [replace(make_rows()[0], episode_return=1 / 3)]
    write_published(tmp_path, Published().with_run(make_run(), rows, []))
    assert read_published(tmp_path).episodes[0].row.episode_return == 0.333
    assert set(contents(tmp_path)) == {"episodes.csv", "runs.csv"}


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("episodes", "none,reach,expert", "none,roach,expert", r"task: .*'roach'; .*push_left"),
        ("episodes", "none,reach,expert", ",reach,expert", r"ablation: .*line 2 is ''; .*a name"),
        ("episodes", "return", "reward", r"return: column is missing"),
        ("curves", "reach,1,1,1000", "reach,1,1.5,1000", r"epoch: .*'1.5'; .*whole number"),
        ("curves", "reach,1,1,1000,1", "reach,1,1,1000,0", r"line 3 repeats line 2"),
        ("curves", "reach,1,1,1000,0", "reach,7,1,1000,0", r"'paper', 'none', 7.* not in runs"),
        ("runs", "paper,none,1", "paper,none,9", r"'paper', 'none', 1.* not in runs"),
        ("runs", "0.989", "much", r"accuracy: .*'much'; expected a finite number"),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, name: str, old: str, new: str, says: str
) -> None:
    write_published(tmp_path, make_published())
    path = tmp_path / f"{name}.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=says):
        read_published(tmp_path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    write_published(tmp_path, make_published())
    (tmp_path / "episodes.csv").unlink()
    with pytest.raises(DataError, match=r"episodes\.csv: no such file"):
        read_published(tmp_path)


def test_rollouts_of_a_run_get_its_task_and_seed(tmp_path: Path) -> None:
    path = tmp_path / "evaluations.csv"
    path.write_text("epoch,update,episode,return,success\n1,10,0,2.5,1\n1,10,1,1.5,0\n")
    rows = read_curve_rows(path, run=("paper", "none", 4), task="lift")
    assert [(r.task, r.seed, r.episode_return, r.success) for r in rows] == [
        ("lift", 4, 2.5, True),
        ("lift", 4, 1.5, False),
    ]
