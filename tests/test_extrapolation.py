"""The extrapolation-error recipe: a whole small run, what it repeats, what it refuses."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("hydra")
pytest.importorskip("imageio")  # gymnasium's MuJoCo tasks import it
pytest.importorskip("mujoco")
pytest.importorskip("safetensors")
pytest.importorskip("tqdm")

import gymnasium
from small_runs import RECIPES, command_line, recipe

from torchrl_bmrl.errors import BMRLError

ALGORITHMS = ["ddpg", "bc", "td3_bc", "iql", "plas", "bcq"]
SMALL = [
    "env=InvertedPendulum-v5",
    "seeds=[5]",
    "behaviour_steps=200",
    "exploration_steps=100",
    "batch_steps=200",
    "updates=4",
    "batch_size=8",
    "eval_episodes=2",
    "workers=1",
]


@pytest.fixture(scope="module")
def extrapolation() -> Any:
    """The recipe's module, importable as it is for a script beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(RECIPES))
        import extrapolation

        yield extrapolation


def row(algorithm: str, seed: int, episode: int, value: float) -> dict[str, str]:
    """As ``results.csv`` is read back: everything is text."""
    values = {"algorithm": algorithm, "seed": seed, "episode": episode, "return": value}
    return {key: str(value) for key, value in values.items()}


def test_the_table_weighs_seeds_alike_and_compares_each_with_its_own_behaviour(extrapolation):
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


def test_the_table_states_no_share_of_a_return_that_is_not_positive(extrapolation):
    rows = [row("behaviour", 0, 0, -5.0), row("bcq", 0, 0, 5.0)]
    assert extrapolation.make_table(rows).splitlines()[-1] == "| bcq | 5 | 5 ± 0 | – |"


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("env=Cheetah-v5", "unknown env 'Cheetah-v5'; valid envs: .*HalfCheetah-v5"),
        ("algorithms=[bcq,cql]", "unknown algorithm 'cql'; valid algorithms: ddpg, bc, .*bcq"),
        ("seeds=[1,1]", r"seeds is \[1, 1\]; valid: at least one, each once"),
        ("updates=0", "updates is 0; valid: above 0"),
        ("exploration_steps=200", "exploration_steps is 200; valid: below behaviour_steps, 200"),
    ],
)
def test_an_invalid_setting_is_one_line_that_says_what_is_valid(
    extrapolation, override: str, says: str
) -> None:
    from hydra import compose, initialize
    from omegaconf import OmegaConf

    with initialize(version_base="1.3", config_path="../recipes/config"):
        config = compose("extrapolation", overrides=[*SMALL, override])
    with pytest.raises(BMRLError, match=f"^{says}") as error:
        extrapolation.check_settings(OmegaConf.to_object(config))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "error", [ImportError("imageio"), gymnasium.error.DependencyNotInstalled("mujoco")]
)
def test_a_package_that_the_task_lacks_is_named(
    extrapolation, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(extrapolation.importlib, "import_module", Mock(side_effect=error))
    with pytest.raises(BMRLError, match=f"needs one more package: {error}"):
        extrapolation.check_settings(extrapolation.Settings(run_dir="runs/mine"))


@pytest.mark.slow
def test_an_error_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command_line("extrapolation", *SMALL, "algorithms=[cql]") == 1
    said = capsys.readouterr().err
    assert said.splitlines()[-1].startswith("error: unknown algorithm 'cql'; valid")
    assert "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_every_algorithm_runs_on_every_batch_and_a_repeated_command_redoes_nothing(
    tmp_path: Path,
) -> None:
    done = recipe("extrapolation", *SMALL, "run_dir=run", cwd=tmp_path, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    run = tmp_path / "run"
    with (run / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    trained = [row for row in rows if row["algorithm"] != "behaviour"]
    assert [(row["algorithm"], row["seed"], row["episode"]) for row in trained] == [
        (name, "5", str(episode)) for name in ALGORITHMS for episode in range(2)
    ]
    assert all(float(row["return"]) >= 0 for row in rows)  # one for each step upright
    assert any(row["algorithm"] == "behaviour" for row in rows)
    assert (run / "table.md").read_text() in done.stdout
    assert not list(run.rglob("*.pt"))

    kept = [*run.glob("batches/*"), *run.glob("results/*")]
    assert len(kept) == 1 + 1 + len(ALGORITHMS)
    written = {path: path.stat().st_mtime_ns for path in kept}
    before = (run / "results.csv").read_bytes()
    (run / "results" / "bc-seed5.csv").unlink()
    del written[run / "results" / "bc-seed5.csv"]
    again = recipe("extrapolation", *SMALL, "run_dir=run", cwd=tmp_path, OMP_NUM_THREADS="1")
    assert again.returncode == 0, again.stderr
    assert {path: path.stat().st_mtime_ns for path in written} == written
    assert (run / "results.csv").read_bytes() == before  # the missing one came out the same
