"""What each section of a run's page contains, in which order and under which titles."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation import ResultRow, write_results
from torchrl_bmrl.reports import Section, Table, figures, write_report, write_study
from torchrl_bmrl.rows import write_rows
from torchrl_bmrl.training.diagnostics import Diagnostics, write_diagnostics

TITLES = {"pour": "Pouring water", "lift": "Lifting"}
"""In the run's order, which is neither that of the rows nor that of the names."""
STAGE_1, STAGE_2 = "Stage 1: one BCQ policy per task", "Stage 2: one distilled policy for all tasks"


def table(title: str) -> Table:
    return Table(title=title, caption="", header=("a",), rows=[("1",)])


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that were drawn."""
    found: list[Any] = []
    original = figures.png
    monkeypatch.setattr(figures, "png", lambda figure: found.append(figure) or original(figure))
    return found


@pytest.fixture
def page(tmp_path: Path, drawn: list[Any]) -> str:
    """The page of a run with results, training curves, a further table and a study."""
    rows = [
        ResultRow(
            task=task,
            policy=policy,
            latent_source="prototype" if policy == "distilled" else "",
            seed=0,
            episode=0,
            episode_return=value,
            success=task == "lift",
        )
        for task, value in (("lift", 50.0), ("pour", 70.0))
        for policy in ("expert", "bcq", "distilled")
    ]
    write_results(tmp_path / "results.csv", rows)
    for task in ("lift", "pour"):
        curve = {"epoch": 1, "update": 50, "episode": 0, "return": 10.0, "success": 0}
        write_rows(tmp_path / "bcq" / task / "evaluations.csv", [curve])
    write_study(tmp_path, "noise", Section(heading="A study", tables=[table("Noise")]), {})
    tables = {"held_out": table("On held-out data")}
    path = write_report(tmp_path, facts={"seed": "0"}, titles=TITLES, tables=tables)
    return path.read_text(encoding="utf-8")


def test_every_section_has_its_tables_and_pictures_in_order(page: str) -> None:
    sections = re.findall(r"<section>\s*<h2>(.*?)</h2>(.*?)</section>", page, re.DOTALL)
    found = [(h, re.findall(r"<h3>(.*?)</h3>", body), body.count("<img ")) for h, body in sections]
    assert found == [
        ("Summary", ["On held-out data"], 0),
        (STAGE_1, ["Table 1: stage 1, one BCQ policy per task"], 1),
        (STAGE_2, ["Table 2: stage 2, one distilled policy for all tasks"], 0),
        ("The task embedding", [], 0),
        ("A study", ["Noise"], 0),
        ("Everything measured", ["Results"], 0),
    ]


def test_tasks_have_the_runs_titles_and_order_everywhere(
    page: str, tmp_path: Path, drawn: list[Any]
) -> None:
    for name in ("table1", "table2"):
        lines = (tmp_path / "tables" / f"{name}.csv").read_text().splitlines()[1:]
        assert [line.split(",")[0] for line in lines] == list(TITLES.values())
    lines = (tmp_path / "tables" / "results.csv").read_text().splitlines()[1:]
    assert [line.split(",")[0] for line in lines] == [*["Pouring water"] * 3, *["Lifting"] * 3]
    assert [axes.get_title() for axes in drawn[0].axes] == list(TITLES.values())
    assert "(least often on Pouring water: 0%)" in page


def test_the_page_forbids_the_browser_to_load_anything(page: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', page)
    assert policy is not None
    assert policy[1].split("; ") == [
        "default-src 'none'",
        "img-src data:",
        "style-src 'unsafe-inline'",
        "script-src 'unsafe-inline'",
    ]


def test_the_explorer_has_the_runs_titles(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    pytest.importorskip("tqdm")
    from torchrl_bmrl.data import Episode, robomimic
    from torchrl_bmrl.reports import Embeddings
    from torchrl_bmrl.reports.films import Films, explore_demonstrations

    parts, zeros = {"x": np.zeros((5, 3))}, np.zeros(1, dtype=int)
    episode = Episode(
        observations=parts,
        next_observations=parts,
        actions=np.zeros((5, 2)),
        rewards=np.zeros(5),
        terminated=np.zeros(5, dtype=bool),
    )
    path = tmp_path / "pour.hdf5"
    robomimic.write_episodes(path, [episode], env_args={}, masks={"valid": [0]})
    embeddings = Embeddings(
        tasks=["pour"], task_latent=np.zeros((1, 2)), task=zeros, episode=zeros, step=zeros
    )
    explorer = explore_demonstrations(tmp_path, embeddings, Films(), titles=TITLES)
    assert explorer.titles == ["Pouring water"]


def diagnosed(ratio: float, share: float = 0.01, kl: Any = None) -> Diagnostics:
    return Diagnostics(
        candidate_spread=0.0123,
        spread_ratio=ratio,
        qvalue_gap=0.5,
        qvalue_std=2.0,
        outside_share=share,
        latent_kl=kl,
    )


def test_the_page_shows_the_last_diagnostics_of_every_agent(tmp_path: Path) -> None:
    agents = {
        "pour": (diagnosed(0.9), diagnosed(0.051, kl=(0.02, 0.001, 0.5))),
        "lift": (diagnosed(1.0), diagnosed(1.7, share=0.7)),
        "lift-1": (diagnosed(0.1), diagnosed(0.96)),
        "lift-3": (diagnosed(0.1), diagnosed(0.1)),  # of no agent of the run
    }
    for name, epochs in agents.items():
        for epoch, found in enumerate(epochs, 1):
            path = tmp_path / "bcq" / name / "diagnostics.csv"
            write_diagnostics(path, found, epoch=epoch, update=500 * epoch)
    page = write_report(tmp_path, facts={}, titles=TITLES).read_text(encoding="utf-8")
    _, _, stage = page.partition(f"<h2>{STAGE_1}</h2>")
    assert "Candidates and critics of stage 1" in stage.partition("</section>")[0]
    table = (tmp_path / "tables" / "diagnostics.csv").read_text(encoding="utf-8")
    assert table.splitlines() == [
        "Agent,Update,Spread,Spread ratio,Value gap,Outside,Active latents,Finding",
        "Pouring water,1000,0.012,0.05,+0.25,1%,2 of 3,clones the demonstrations",
        "Lifting,1000,0.012,1.70,+0.25,70%,–,leaves the demonstrations",
        '"Lifting, 1",1000,0.012,0.96,+0.25,1%,–,–',
    ]


def test_a_page_without_diagnostics_has_no_table_of_them(page: str, tmp_path: Path) -> None:
    assert "Candidates and critics" not in page
    assert not (tmp_path / "tables" / "diagnostics.csv").exists()


def test_a_file_of_diagnostics_that_is_not_one_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "bcq" / "lift" / "diagnostics.csv"
    write_diagnostics(path, diagnosed(1.0), epoch=1, update=500)
    path.write_text(path.read_text().replace("0.0123", "much"))
    with pytest.raises(DataError, match=r"diagnostics\.csv: candidate_spread: .*'much'"):
        write_report(tmp_path, facts={}, titles=TITLES)
