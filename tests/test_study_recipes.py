"""Recipes that study a finished run: imitation, interpolation, learning on top."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from omegaconf import OmegaConf
from small_runs import (
    HORIZON,
    SMALL,
    Run,
    configured,
    contents,
    times,
)

# -- one-shot imitation ----------------------------------------------------------------------------

IMITATE = ["imitate.composition=reach-lift", "imitate.demonstrations=2", "imitate.episodes=4"]
FEW = "imitate.cloning_updates=50"  # where it does not matter how well a clone does


@pytest.mark.robosuite
@pytest.mark.slow
def test_imitation_compares_every_method_and_perturbation_and_goes_on(
    run: Run, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import imitate

    monkeypatch.setattr(imitate, "PERTURBATIONS", ("none", "both, constant"))
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    run(folder, imitate.imitate, *IMITATE, FEW)
    with (folder / "imitation" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    cells = {(row["method"], row["perturbation"], row["demonstration"]) for row in rows}
    assert len(cells) == len(imitate.METHODS) * 2 * 2
    assert len(rows) == 2 * len(cells)
    assert {row["stages"] for row in rows} <= {"0", "1", "2"}
    assert all((row["stages"] == "2") == (row["success"] == "1") for row in rows)
    table = (folder / "tables" / "imitation.csv").read_text().splitlines()
    assert table[0] == "Method,Perturbation,1. Reach,2. Lift,Whole,95% interval,Episodes"
    assert len(table) == 1 + len(imitate.METHODS) * 2

    written = contents(folder, "imitation/*", "tables/imitation.*")
    (folder / "imitation" / "replay-none-1.csv").unlink()  # as a kill would leave it
    run(folder, imitate.imitate, *IMITATE, FEW)
    assert contents(folder, "imitation/*", "tables/imitation.*") == written

    # A study is held to its own settings; the run's others stay free.
    with pytest.raises(SystemExit):
        run(folder, imitate.imitate, *IMITATE, FEW, "imitate.max_angle=10")


@pytest.mark.robosuite
@pytest.mark.slow
def test_what_drives_imitation_is_one_demonstration_from_another_start(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    import imitate

    from torchrl_bmrl.data.demonstrations import read_statistics

    settings = configured(*SMALL, *IMITATE, f"run_dir={tmp_path}", "workers=1")
    config = OmegaConf.to_object(settings)
    paths = [imitate.demonstrate(config, number) for number in (0, 1)]
    statistics = read_statistics(finished / "data")
    first, second = (imitate.read_demonstration(path, statistics) for path in paths)
    assert first["stage"].unique().tolist() == second["stage"].unique().tolist() == [0, 1, 2]
    assert not torch.equal(first["observation"][0], second["observation"][0])
    # Open loop: the actions of the demonstration, whatever happens.
    policy, (counter,) = imitate.make_method(config, "replay", paths[0], statistics)
    from torchrl_bmrl.envs.transforms import make_env

    played = make_env("reach-lift", statistics, counter).rollout(20, policy)
    assert torch.equal(played["action"], first["action"][:20])
    # Cloning fits that demonstration.
    clone, _ = imitate.make_method(config, "cloning", paths[0], statistics)
    error = (clone(first.select("observation"))["action"] - first["action"]).square().mean()
    assert error < 0.5 * first["action"].var(0).mean()


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["imitate.composition=reach-push_up"], "imitate.composition is reach-push_up, but the"),
        (["imitate.composition=reach-lfit"], "unknown task 'lfit'"),
        (["imitate.episodes=7", "imitate.demonstrations=2"], "a multiple of"),
        ([], "checkpoint.safetensors"),
    ],
    ids=["task the policy lacks", "no task", "uneven episodes", "no student"],
)
def test_imitation_names_what_is_wrong_and_writes_no_study(
    recipes: Any, tmp_path: Path, overrides: list[str], says: str, capsys: Any
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    import imitate

    settings = configured(*SMALL, *overrides, f"run_dir={tmp_path}", "workers=1")
    with pytest.raises(SystemExit):
        recipes.run_recipe(settings, imitate.imitate)
    assert says in capsys.readouterr().err
    assert not (tmp_path / "imitation").exists()


# -- interpolation ---------------------------------------------------------------------------------


@pytest.mark.robosuite
@pytest.mark.slow
def test_interpolation_plays_every_method_beside_what_it_is_compared_with(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("sklearn")
    import collect
    import distill
    import interpolate
    import train_bcq

    from torchrl_bmrl.evaluation import rollout

    monkeypatch.setitem(rollout.rollout_episodes.__kwdefaults__, "max_steps", HORIZON)
    options = ["collect.valid_episodes=2", "distill.task_latent_dim=3", "interpolation.episodes=4"]
    for stage in (collect.collect, train_bcq.train_all, distill.distill, interpolate.interpolate):
        run(tmp_path, stage, *options)

    folder = tmp_path / "interpolation" / "lift-4"
    rows = {path.stem: list(csv.DictReader(path.open())) for path in folder.glob("*.csv")}
    noises = {f"{name}_noise" for name in interpolate.WITH_NOISE}
    assert set(rows) == {*interpolate.METHODS, *noises, *interpolate.SWITCHES}
    assert {len(part) for part in rows.values()} == {4 * HORIZON}

    def column(name: str, field: str) -> list[float]:
        return [float(row[field]) for row in rows[name]]

    # Lift starts 10 cm above the cube, whatever the method, from the same places.
    for name in set(rows) - set(interpolate.SWITCHES):
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

    for name, lines in (("interpolation", len(interpolate.METHODS) + 2), ("switching", 3)):
        table = (tmp_path / "tables" / f"{name}.csv").read_text().splitlines()
        assert len(table) == 1 + lines
        page = (tmp_path / "tables" / f"{name}.md").read_text()
        assert f"\n| {table[1].split(',')[0]} | 4 |" in page
    for name in ("trajectories", "paths"):
        picture = tmp_path / "figures" / f"interpolation_{name}.png"
        assert picture.read_bytes()[1:4] == b"PNG"

    before = contents(tmp_path, "interpolation/**/*", "tables/*", "figures/*")
    written = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    (folder / "straight_noise.csv").unlink()
    run(tmp_path, interpolate.interpolate, *options)
    assert contents(tmp_path, "interpolation/**/*", "tables/*", "figures/*") == before
    again = {path.stem for path in folder.iterdir() if path.stat().st_mtime_ns != written[path]}
    assert again == {"straight", "straight_noise"}
    for option, says in (
        ("interpolation.task=push_up", "interpolation.task is push_up; valid: one of tasks"),
        ("interpolation.episodes=1", "interpolation.episodes is 1; valid: at least one for each"),
    ):
        with pytest.raises(SystemExit):
            run(tmp_path, interpolate.interpolate, *options, option)
        assert says in capsys.readouterr().err


def test_an_outcome_counts_as_neither_when_no_end_of_the_path_has_it(recipes: Any) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    pytest.importorskip("matplotlib")
    import interpolation_report

    ends = {"lift": (0, 0, 0.1), "push_up": (0.1, 0, 0), "reach": (0, 0, 0)}

    def episodes(*labelled: tuple[str, tuple[float, ...]]) -> dict[str, Any]:
        cube = torch.zeros(len(labelled), 2, 3).numpy()
        for i, (_, end) in enumerate(labelled):
            cube[i, -1] = end
        return {"cube": cube, "label": [label for label, _ in labelled]}

    # One push that failed does not make "still" usual.
    tasks = episodes(*ends.items(), *ends.items(), ("push_up", (0, 0, 0)))
    lift, up, still = ends.values()
    between = [("push_up", lift), ("push_up", up), ("push_up", still), ("reach", up)]
    share = interpolation_report.share_of_neither("lift", episodes(*between), tasks)
    assert share == "50%"


# -- learning on top -------------------------------------------------------------------------------

SAC = (
    "latent_sac.hold=5",
    "latent_sac.environment_steps=250",
    "latent_sac.random_steps=100",
    "latent_sac.eval_interval=200",
    "latent_sac.eval_episodes=2",
    "latent_sac.num_candidates=3",
)


@pytest.mark.robosuite
@pytest.mark.slow
def test_sac_learns_on_top_of_a_finished_run_and_keeps_every_agent(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    import latent_sac

    folder = shutil.copytree(finished, tmp_path / "run")
    before = times(folder)
    run(folder, latent_sac.latent_sac, *SAC, "latent_sac.seeds=[4]")
    kept = folder / "latent_sac" / "reach-lift-hold5"
    with (kept / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
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
    table = (folder / "tables" / "latent_sac-reach-lift-hold5.md").read_text()
    assert "| latent | 4 | not within 250 |" in table
    assert (folder / "figures" / "latent_sac-reach-lift-hold5.png").read_bytes()[1:4] == b"PNG"
    assert before.items() <= times(folder).items()  # the run itself is as it was

    agents = contents(kept, "*-seed4.csv")
    written = {path: path.stat().st_mtime_ns for path in kept.glob("*-seed4.csv")}
    run(folder, latent_sac.latent_sac, *SAC, "latent_sac.seeds=[4,5]")
    assert {path: path.stat().st_mtime_ns for path in written} == written
    assert len(contents(kept, "*-seed*.csv")) == 2 * len(agents) == 4
    capsys.readouterr()
    with pytest.raises(SystemExit):
        run(folder, latent_sac.latent_sac, *SAC, "latent_sac.eval_episodes=3")
    assert "eval_episodes is 3 here and 2 in the folder's run" in capsys.readouterr().err


@pytest.mark.robosuite
@pytest.mark.slow
def test_one_seed_learns_the_same_twice(run: Run, finished: Path, tmp_path: Path) -> None:
    import latent_sac

    rows = []
    for name in ("a", "b"):
        shutil.copytree(finished / "data", tmp_path / name / "data")
        shutil.copytree(finished / "distill", tmp_path / name / "distill")
        config = OmegaConf.to_object(configured(*SMALL, *SAC, f"run_dir={tmp_path / name}"))
        latent_sac.train_job((config, "latent", 0), lambda count: None)
        rows.append(contents(tmp_path / name, "latent_sac/*/*.csv"))
    assert rows[0] == rows[1] != {}


def test_steps_to_half_are_those_of_the_first_evaluation_that_reaches_it(recipes: Any) -> None:
    pytest.importorskip("matplotlib")
    import latent_sac

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

    assert latent_sac.steps_to_half(agent(0.0, 0.4, 0.5, 0.3, 0.9)) == 200
    assert latent_sac.steps_to_half(agent(0.0, 0.4)) is None
    config = OmegaConf.to_object(configured("preset=smoke", "run_dir=run"))
    table = latent_sac.make_table(config, [agent(0.0, 0.6, 0.2), agent(0.1, 0.4)])
    assert table.rows[0] == ("latent", "3", "100", "0%", "60%", "20%", "0.4")
    assert table.rows[1][2] == "not within 20,000"
