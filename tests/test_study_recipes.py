"""Studies of a finished run: imitation, interpolation, learning on top."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("sklearn")
pytest.importorskip("tqdm")

import small_runs
from small_runs import HORIZON, SMALL, configured, contents, times

from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.pipeline import Run, collect, stage1, stage2
from torchrl_bmrl.run.settings import check_settings
from torchrl_bmrl.studies import imitation, interpolation, interpolation_report
from torchrl_bmrl.studies.imitation import ImitateSettings, imitate
from torchrl_bmrl.studies.interpolation import InterpolationSettings, interpolate
from torchrl_bmrl.studies.latent_sac import (
    LatentSACSettings,
    latent_sac,
    make_table,
    steps_to_half,
    train_job,
)

pytestmark = pytest.mark.usefixtures("recipes")  # which know the settings by name


def make_run(folder: Path) -> Run:
    overrides = ("workers=1", "collect.valid_episodes=2", "distill.task_latent_dim=3")
    return small_runs.make_run(folder, *overrides)


def study(folder: Path, function: Any, settings: Any) -> str:
    with make_run(folder) as run:
        return function(run, settings)


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def distilled(recipes: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with demonstrations and both stages."""
    pytest.importorskip("robosuite", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("distilled")
    with make_run(folder) as run:
        for stage in (collect, stage1, stage2):
            stage(run)
    return folder


@pytest.fixture
def folder(distilled: Path, tmp_path: Path) -> Path:
    """A copy of it for one test."""
    return shutil.copytree(distilled, tmp_path / "run")


# -- one-shot imitation ----------------------------------------------------------------------------

IMITATE = ImitateSettings(
    composition="reach-lift", demonstrations=2, episodes=4, cloning_updates=50
)


@pytest.mark.robosuite
@pytest.mark.slow
def test_imitation_compares_every_method_and_perturbation_and_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imitation, "PERTURBATIONS", ("none", "both, constant"))
    said = study(folder, imitate, IMITATE)
    rows = read(folder / "imitation" / "results.csv")
    cells = {(row["method"], row["perturbation"], row["demonstration"]) for row in rows}
    assert len(cells) == len(imitation.METHODS) * 2 * 2
    assert len(rows) == 2 * len(cells)
    assert {row["stages"] for row in rows} <= {"0", "1", "2"}
    assert all((row["stages"] == "2") == (row["success"] == "1") for row in rows)
    table = (folder / "tables" / "imitation.csv").read_text().splitlines()
    assert table[0] == "Method,Perturbation,1. Reach,2. Lift,Whole,95% interval,Episodes"
    assert len(table) == 1 + len(imitation.METHODS) * 2
    assert said == (folder / "tables" / "imitation.md").read_text()

    written = contents(folder, "imitation/*", "tables/imitation.*")
    (folder / "imitation" / "replay-none-1.csv").unlink()  # as a kill would leave it
    study(folder, imitate, IMITATE)
    assert contents(folder, "imitation/*", "tables/imitation.*") == written

    # A study is held to its own settings; the run's others stay free.
    with pytest.raises(ConfigError, match=r"max_angle is 10\.0 here and 45\.0"):
        study(folder, imitate, replace(IMITATE, max_angle=10.0))


@pytest.mark.robosuite
@pytest.mark.slow
def test_what_drives_imitation_is_one_demonstration_from_another_start(folder: Path) -> None:
    settings = replace(IMITATE, cloning_updates=2000)
    run = make_run(folder)
    task = run.composition("reach-lift")
    first, second = (imitation.demonstrate(run, task, number) for number in (0, 1))
    assert first["stage"].unique().tolist() == second["stage"].unique().tolist() == [0, 1, 2]
    assert not torch.equal(first["observation"][0], second["observation"][0])
    # Open loop: the actions of the demonstration, whatever happens.
    policy, (counter,) = imitation.make_method(run, settings, "replay", 0)
    played = run.make_env(task, counter, num_envs=1).rollout(20, policy)
    assert torch.equal(played["action"][0], first["action"][:20])
    # Cloning fits that demonstration.
    clone, _ = imitation.make_method(run, settings, "cloning", 0)
    error = (clone(first.select("observation"))["action"] - first["action"]).square().mean()
    assert error < 0.5 * first["action"].var(0).mean()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (ImitateSettings(composition="reach-push_up"), "unknown task of the run 'push_up'"),
        (ImitateSettings(composition="reach"), "imitate.composition is reach; valid: several"),
        (ImitateSettings(episodes=7, demonstrations=2), "a multiple of"),
        (ImitateSettings(magnitude=(1.5, 0.5)), "two factors, low to high"),
        (ImitateSettings(), "checkpoint.safetensors"),
    ],
    ids=["task that the run lacks", "one task", "uneven episodes", "range", "no student"],
)
def test_imitation_names_what_is_wrong_and_writes_no_study(
    tmp_path: Path, settings: ImitateSettings, says: str
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    with pytest.raises(BMRLError, match=says):
        study(tmp_path, imitate, settings)
    assert not (tmp_path / "imitation").exists()


@pytest.mark.parametrize(
    ("recipe", "override", "says"),
    [
        ("imitate", "imitate.composition=reach-lfit", "unknown task of the run 'lfit'"),
        ("imitate", "imitate.magnitude=[0,1]", "imitate.magnitude is 0.0; valid: above 0"),
        ("interpolate", "interpolation.task=push_up", "interpolation.task is push_up; valid: one"),
        ("latent_sac", "latent_sac.seeds=[]", "latent_sac.seeds is []; valid: at least one"),
        ("latent_sac", "latent_sac.random_steps=30000", "valid: 0 to environment_steps"),
    ],
)
def test_the_recipes_take_a_studys_settings_from_the_command_line(
    recipes: Any, tmp_path: Path, recipe: str, override: str, says: str, capsys: Any
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    import importlib

    main = importlib.import_module(recipe).main.__wrapped__
    with pytest.raises(SystemExit, match="1"):
        main(configured(*SMALL, override, f"run_dir={tmp_path}", "workers=1"))
    error = capsys.readouterr().err
    assert says in error
    assert "Traceback" not in error


# -- interpolation ---------------------------------------------------------------------------------

INTERPOLATION = InterpolationSettings(episodes=4)


@pytest.mark.robosuite
@pytest.mark.slow
def test_interpolation_plays_every_method_beside_what_it_is_compared_with(folder: Path) -> None:
    said = study(folder, interpolate, INTERPOLATION)
    kept = folder / "interpolation" / "lift-4"
    rows = {path.stem: read(path) for path in kept.glob("*.csv")}
    methods, switches = interpolation.METHODS, interpolation.SWITCHES
    noises = {f"{name}_noise" for name in interpolation.WITH_NOISE}
    assert set(rows) == {*methods, *noises, *switches}
    assert {len(part) for part in rows.values()} == {4 * HORIZON}

    def column(name: str, field: str) -> list[float]:
        return [float(row[field]) for row in rows[name]]

    # Lift starts 10 cm above the cube, whatever the method, from the same places.
    for name in set(rows) - set(switches):
        starts = [row for row in rows[name] if row["step"] == "0"]
        for row, expected in zip(starts, rows["prototype"][::HORIZON], strict=True):
            assert float(row["eef_z"]) - float(row["goal_z"]) == pytest.approx(0.1, abs=1e-3)
            assert float(row["eef_x"]) == pytest.approx(float(row["goal_x"]), abs=1e-3)
            assert row["goal_x"] == expected["goal_x"]
    # The same m and the same proposals are the same action; another m is another.
    assert set(column("prototype", "deviation")) == {0.0}
    assert sum(column("straight", "deviation")) > 0
    size, noise = (sum(column(name, "deviation")) for name in ("straight", "straight_noise"))
    assert noise == pytest.approx(size, rel=0.3)
    assert column("straight", "along")[::HORIZON] == [0.25, 0.5, 0.75, 1.0]
    step = pytest.approx(1 / (HORIZON - 1), abs=1e-4)
    assert column("curve_moving", "along")[:2] == [0.0, step]

    for name, lines in (("interpolation", len(methods) + 2), ("switching", 3)):
        table = (folder / "tables" / f"{name}.csv").read_text().splitlines()
        assert len(table) == 1 + lines
        page = (folder / "tables" / f"{name}.md").read_text()
        assert f"\n| {table[1].split(',')[0]} | 4 |" in page
        assert page in said
    for name in ("trajectories", "paths"):
        picture = folder / "figures" / f"interpolation_{name}.png"
        assert picture.read_bytes()[1:4] == b"PNG"

    before = contents(folder, "interpolation/**/*", "tables/*", "figures/*")
    written = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
    (kept / "straight_noise.csv").unlink()
    study(folder, interpolate, INTERPOLATION)
    assert contents(folder, "interpolation/**/*", "tables/*", "figures/*") == before
    again = {path.stem for path in kept.iterdir() if path.stat().st_mtime_ns != written[path]}
    assert again == {"straight", "straight_noise"}


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"task": "push_up"}, "interpolation.task is push_up; valid: one of tasks"),
        ({"episodes": 1}, "interpolation.episodes is 1; valid: at least one for each"),
        ({"cube": "robot0_eef_quat"}, "no position robot0_eef_quat"),
        ({"eef": "hand"}, "no position hand"),
    ],
)
def test_interpolation_names_a_setting_that_is_not_valid_and_keeps_no_such_setting(
    folder: Path, change: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        study(folder, interpolate, replace(INTERPOLATION, **change))
    assert not (folder / "interpolation").exists()


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_columns_of_a_position_are_found_in_the_demonstrations(distilled: Path) -> None:
    run = make_run(distilled)
    for name in ("lift", "reach"):
        found = interpolation.position_columns(run, INTERPOLATION, name)
        assert found == {"eef": [23, 24, 25], "cube": [30, 31, 32]}


def episodes(*labelled: tuple[str, tuple[float, ...]]) -> dict[str, Any]:
    """Two steps of each episode, after which the cube is somewhere."""
    cube = torch.zeros(len(labelled), 2, 3).numpy()
    for i, (_, end) in enumerate(labelled):
        cube[i, -1] = end
    return {"cube": cube, "label": [label for label, _ in labelled]}


def test_an_outcome_counts_as_neither_when_no_end_of_the_path_has_it() -> None:
    ends = {"lift": (0, 0, 0.1), "push_up": (0.1, 0, 0), "reach": (0, 0, 0)}
    # One push that failed does not make "still" usual.
    tasks = episodes(*ends.items(), *ends.items(), ("push_up", (0, 0, 0)))
    lift, up, still = ends.values()
    between = [("push_up", lift), ("push_up", up), ("push_up", still), ("reach", up)]
    share = interpolation_report.share_of_neither("lift", episodes(*between), tasks)
    assert share == "50%"


@pytest.mark.parametrize(("end", "shown"), [((0, 0, 0), False), ((0, 0, 0.1), True)])
def test_the_table_has_nothing_of_a_cube_that_never_moves(
    end: tuple[float, ...], shown: bool
) -> None:
    still = {"eef": torch.zeros(1, 2, 3).numpy(), "deviation": torch.zeros(1, 2).numpy()}
    played = {
        "prototype": still | episodes(("", (0, 0, 0))),
        "tasks": still | episodes(("reach", end)),
    }
    table = interpolation_report.method_table("reach", played, 20.0)
    assert [row[-1] != "–" for row in table.rows] == [shown] * 2


# -- learning on top -------------------------------------------------------------------------------

SAC = LatentSACSettings(
    hold=5,
    environment_steps=250,
    random_steps=100,
    eval_interval=200,
    eval_episodes=2,
    num_candidates=3,
    seeds=[4],
)


@pytest.mark.robosuite
@pytest.mark.slow
def test_sac_learns_on_top_of_a_finished_run_and_keeps_every_agent(folder: Path) -> None:
    before = times(folder)
    said = study(folder, latent_sac, SAC)
    kept = folder / "latent_sac" / "reach-lift-hold5"
    rows = read(kept / "results.csv")
    # Chunks of 20 steps in five environments; evaluated before, from 200 on and at the end.
    assert [(row["variant"], row["environment_steps"]) for row in rows] == [
        ("latent", "0"),
        ("latent", "200"),
        ("latent", "300"),
        ("raw", "0"),
        ("raw", "200"),
        ("raw", "300"),
    ]
    assert all(0 <= float(row["success"]) <= 1 and 0 <= float(row["stages"]) <= 2 for row in rows)
    assert said == (folder / "tables" / "latent_sac-reach-lift-hold5.md").read_text()
    assert "| latent | 4 | not within 250 |" in said
    assert (folder / "figures" / "latent_sac-reach-lift-hold5.png").read_bytes()[1:4] == b"PNG"
    assert before.items() <= times(folder).items()  # the run itself is as it was

    agents = contents(kept, "*-seed4.csv")
    written = {path: path.stat().st_mtime_ns for path in kept.glob("*-seed4.csv")}
    study(folder, latent_sac, replace(SAC, seeds=[4, 5]))
    assert {path: path.stat().st_mtime_ns for path in written} == written
    assert len(contents(kept, "*-seed*.csv")) == 2 * len(agents) == 4
    with pytest.raises(ConfigError, match="eval_episodes is 3 here and 2 in the folder's run"):
        study(folder, latent_sac, replace(SAC, eval_episodes=3))


@pytest.mark.robosuite
@pytest.mark.slow
def test_one_seed_learns_the_same_twice(distilled: Path, tmp_path: Path) -> None:
    rows = []
    for name in ("a", "b"):
        shutil.copytree(distilled / "data", tmp_path / name / "data")
        shutil.copytree(distilled / "distill", tmp_path / name / "distill")
        train_job((make_run(tmp_path / name), (SAC, "latent", 0)), lambda count: None)
        rows.append(contents(tmp_path / name, "latent_sac/*/*.csv"))
    assert rows[0] == rows[1] != {}


def test_steps_to_half_are_those_of_the_first_evaluation_that_reaches_it() -> None:
    def agent(*successes: float) -> list[dict[str, Any]]:
        return [
            {
                "variant": "latent",
                "seed": 3,
                "environment_steps": 100 * i,
                "success": success,
                "stages": 2 * success,
            }
            for i, success in enumerate(successes)
        ]

    assert steps_to_half(agent(0.0, 0.4, 0.5, 0.3, 0.9)) == 200
    assert steps_to_half(agent(0.0, 0.4)) is None
    table = make_table(LatentSACSettings(), [agent(0.0, 0.6, 0.2), agent(0.1, 0.4)])
    assert table.rows[0] == ("latent", "3", "100", "0%", "60%", "20%", "0.4")
    assert table.rows[1][2] == "not within 20,000"


def test_the_defaults_of_all_studies_are_valid() -> None:
    for settings in (ImitateSettings(), InterpolationSettings(), LatentSACSettings()):
        check_settings(settings)
