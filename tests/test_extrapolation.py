"""The extrapolation-error experiment: a whole small run, what it repeats, what it refuses."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("imageio")  # gymnasium's MuJoCo tasks import it
pytest.importorskip("mujoco")
pytest.importorskip("safetensors")
pytest.importorskip("tqdm")

DOCS = Path(__file__).parents[1] / "docs"
ALGORITHMS = ["ddpg", "bc", "td3_bc", "iql", "plas", "bcq"]
SMALL = [
    *("--env", "InvertedPendulum-v5", "--seeds", "5", "--behaviour-steps", "200"),
    *("--exploration-steps", "100", "--batch-steps", "200", "--updates", "4"),
    *("--batch-size", "8", "--eval-episodes", "2", "--workers", "1"),
]


@pytest.fixture(scope="module")
def extrapolation() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        import extrapolation

        return extrapolation


def run(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(DOCS / "extrapolation.py"), *SMALL, *words],
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=900,
    )


def row(algorithm: str, seed: int, episode: int, value: float) -> dict[str, Any]:
    return {"algorithm": algorithm, "seed": seed, "episode": episode, "return": value}


def test_the_table_weighs_seeds_alike_and_compares_each_with_its_own_behaviour(
    extrapolation: ModuleType,
) -> None:
    rows = [
        row("behaviour", 0, 0, 100.0),
        *(row("behaviour", 1, i, 150.0 + 50 * i) for i in range(3)),  # mean 200
        row("bcq", 0, 0, 120.0),
        row("bcq", 0, 1, 80.0),
        row("bcq", 1, 0, 100.0),
        row("ddpg", 0, 0, -30.0),
        row("ddpg", 1, 0, -10.0),
    ]
    assert extrapolation.make_table(rows).splitlines() == [
        "| Algorithm | Seed 0 | Seed 1 | Mean ± std | Of behaviour |",
        "| --- | ---: | ---: | ---: | ---: |",
        "| behaviour | 100 | 200 | 150 ± 50 | 100% |",
        "| bcq | 100 | 100 | 100 ± 0 | 75% |",
        "| ddpg | -30 | -10 | -20 ± 10 | -18% |",
    ]


def test_the_table_states_no_share_of_a_return_that_is_not_positive(
    extrapolation: ModuleType,
) -> None:
    rows = [row("behaviour", 0, 0, -5.0), row("bcq", 0, 0, 5.0)]
    assert extrapolation.make_table(rows).splitlines()[-1] == "| bcq | 5 | 5 ± 0 | – |"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--algorithms", "bcq", "cql"], "invalid choice: 'cql'"),
        (["--updates", "0"], "argument --updates: invalid positive value: '0'"),
        (["--exploration-steps", "200"], "valid: fewer than 200, the behaviour's steps"),
    ],
)
def test_an_option_that_is_not_valid_is_refused(
    extrapolation: ModuleType, words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        extrapolation.parse([*SMALL, *words])
    assert says in capsys.readouterr().err


@pytest.mark.slow
def test_every_algorithm_runs_on_every_batch_and_a_repeated_command_redoes_nothing(
    tmp_path: Path,
) -> None:
    done = run("--run-dir", "run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "run"
    with (folder / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    trained = [row for row in rows if row["algorithm"] != "behaviour"]
    assert [(row["algorithm"], row["seed"], row["episode"]) for row in trained] == [
        (name, "5", str(episode)) for name in ALGORITHMS for episode in range(2)
    ]
    assert all(float(row["return"]) >= 0 for row in rows)  # one for each step upright
    assert any(row["algorithm"] == "behaviour" for row in rows)
    assert (folder / "table.md").read_text() in done.stdout

    kept = [*folder.glob("batches/*"), *folder.glob("results/*")]
    assert len(kept) == 1 + 1 + len(ALGORITHMS)
    written = {path: path.stat().st_mtime_ns for path in kept}
    before = (folder / "results.csv").read_bytes()
    (folder / "results" / "bc-seed5.csv").unlink()
    del written[folder / "results" / "bc-seed5.csv"]
    again = run("--run-dir", "run", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert {path: path.stat().st_mtime_ns for path in written} == written
    assert (folder / "results.csv").read_bytes() == before  # the missing one came out the same
    other = run("--run-dir", "run", "--updates", "5", cwd=tmp_path)
    assert other.returncode == 1
    assert "updates is 5 here and 4 in the folder's run" in other.stderr
