"""The recipes: errors of the command line, whole runs, runs that go on, runs that repeat."""

from __future__ import annotations

import ast
import csv
import gc
import json
import os
import re
import shutil
import subprocess
import sys
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

import yaml
from omegaconf import OmegaConf
from small_runs import (
    HORIZON,
    RECIPES,
    SMALL,
    Interruption,
    Run,
    command_line,
    configured,
    contents,
    short_episodes,
    times,
)

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation import RESULT_FIELDS, read_results, write_results


def recipe(name: str, *overrides: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """Runs a recipe as a person would."""
    return subprocess.run(
        [sys.executable, str(RECIPES / f"{name}.py"), *overrides],
        cwd=cwd,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        timeout=900,
    )


# -- the command line ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["preset=smoke", "bcq.lrr=1"], ["bcq.lrr", "BCQSettings"]),
        (["preset=smoke", "bcq.lr=abc"], ["bcq.lr", "'abc'", "Float"]),
        (["preset=smoke", "tasks=[lfit]"], ["error: unknown task 'lfit'", "reach, lift, push_r"]),
        (["preset=fast"], ["preset/fast", "compose", "literal", "paper", "quick", "smoke"]),
        (["preset=smoke", "logger=log"], ["unknown logger 'log'", "csv, wandb, tensorboard, none"]),
        (["preset=smoke", "distill.updates=-5"], ["error: distill.updates is -5", "above 0"]),
    ],
    ids=["unknown key", "wrong type", "unknown task", "unknown preset", "unknown logger", "range"],
)
def test_an_invalid_setting_is_named_and_nothing_is_written(
    tmp_path: Path,
    overrides: list[str],
    says: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command_line("train_bcq", *overrides) == 1
    said = capsys.readouterr()
    for part in says:
        assert part in said.err
    assert "Traceback" not in said.out + said.err
    assert list(tmp_path.iterdir()) == []


def test_training_without_data_says_which_file_is_missing_and_who_writes_it(tmp_path: Path) -> None:
    done = recipe(
        "train_bcq", "preset=smoke", "tasks=[lift]", "workers=1", "run_dir=run", cwd=tmp_path
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "error: run/data/statistics.json: no such file; recipes/collect.py writes it"
    )
    assert "Traceback" not in done.stderr
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left == {"config.yaml", "versions.json", ".locks"}


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("tasks=[]", r"tasks is \[\]"),
        ("tasks=[lift,lift]", "each once"),
        ("only=[]", r"only is \[\]; valid: some of .'reach', 'lift'"),
        ("only=[lift,lift]", "only is .'lift', 'lift'.; valid: .*each once"),
        ("only=[lfit]", "only is .'lfit'.; valid: some of .'reach', 'lift'"),
        ("+collect.train_episodes.lfit=1", "unknown task 'lfit'"),
        ("collect.train_episodes.lift=0", "collect.train_episodes"),
        ("collect.valid_episodes=0", "collect.valid_episodes"),
        ("evaluate.latent_sources=[]", r"evaluate.latent_sources is \[\]"),
        ("evaluate.latent_sources=[mean]", "'mean'; .*prototype, online, demonstration"),
        ("distill.context=next", "distill.context 'next'; .*current, previous, random, set"),
        ("distill.task_encoder=two_hot", "distill.task_encoder 'two_hot'; .*transition, one_hot"),
        ("distill.task_encoder=one_hot", "task_encoder is one_hot.*isometry_weight=0"),
        ("distill.prototype=mode", "distill.prototype 'mode'; .*mean, medoid"),
        ("bcq.loss_function=l3", "bcq.loss_function 'l3'; .*l2, l1, smooth_l1"),
        ("bcq.kl_reduction=max", "bcq.kl_reduction 'max'; .*mean, sum"),
        ("bcq.lmbda=1.5", "bcq.lmbda is 1.5; valid: between 0 and 1"),
        ("bcq.generator_warmup=-1", "bcq.generator_warmup is -1; valid: 0 or above"),
        ("bcq.critic_grad_clip=0", "bcq.critic_grad_clip is 0.0; valid: above 0, or null"),
        ("bcq.value_bounds=[1,0]", r"value_bounds are .1.0, 0.0.; valid: .*low < high"),
        ("distill.encoder_terms=[critic]", "unknown encoder term 'critic'; .*qvalue, metric"),
        ("distill.metric_weight=-1", "distill.metric_weight is -1.0; valid: 0 or above"),
        ("distill.isometry_weight=-1", "distill.isometry_weight is -1.0; valid: 0 or above"),
        ("workers=0", "workers is 0"),
        ("bcq.lr=0", "bcq.lr is 0"),
        ("bcq.seeds=0", "bcq.seeds is 0"),
        (("only=[lift]", "bcq.stacked=true"), "only is .*; valid: null with bcq.stacked"),
        ("bcq.target_dtype=float8", "bcq.target_dtype 'float8'; .*None, bfloat16"),
        ("device=gpu", "device is 'gpu'; valid: one that torch can use"),
        ("bcq.eval_episodes=0", "bcq.eval_episodes is 0"),
        ("evaluate.episodes=-1", "evaluate.episodes is -1"),
        ("interpolation.episodes=0", "interpolation.episodes is 0"),
        ("interpolation.task=lfit", "unknown task 'lfit'"),
        ("checkpoint_interval=0", "checkpoint_interval is 0"),
        ("latent_sac.composition=reach-lfit", "unknown task 'lfit'"),
        ("latent_sac.hold=0", "latent_sac.hold is 0"),
        ("latent_sac.seeds=[1,1]", r"latent_sac.seeds is \[1, 1\]; valid: at least one, each once"),
        ("latent_sac.random_steps=-1", "latent_sac.random_steps is -1; valid: 0 or above"),
        ("baselines.algorithms=[ddpg]", "unknown baseline 'ddpg'; .*td3_bc, iql, cql, bcq_one_hot"),
        ("baselines.algorithms=[bc,bc]", r"baselines.algorithms is .*; valid: .*each once"),
        ("baselines.updates=0", "baselines.updates is 0; valid: above 0, or null"),
    ],
)
def test_every_stage_is_checked_before_the_first_one_starts(
    recipes: Any, tmp_path: Path, override: str | tuple[str, ...], says: str
) -> None:
    overrides = [override] if isinstance(override, str) else override
    config = OmegaConf.to_object(configured("preset=smoke", f"run_dir={tmp_path}", *overrides))
    with pytest.raises(BMRLError, match=says):
        recipes.check_settings(config)


@pytest.mark.parametrize(
    "name", sorted(path.stem for path in RECIPES.glob("*.py") if "@hydra.main" in path.read_text())
)
def test_a_recipes_help_says_what_it_does_and_shows_how(name: str) -> None:
    text = ast.get_docstring(ast.parse((RECIPES / f"{name}.py").read_text())) or ""
    lines = text.splitlines()
    assert lines[0].endswith((".", "?"))
    assert any(line.strip().startswith(f"python recipes/{name}.py") for line in lines)
    assert len(lines) <= 16  # the rest of the help has 21, a screen 40


def test_help_is_one_screen_with_every_preset_and_ablation_and_leaves_nothing(
    tmp_path: Path,
) -> None:
    done = recipe("two_stage", "--help", cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert (done.returncode, done.stderr) == (0, "")
    assert lines[0] == "The whole pipeline: demonstrations, stage 1, stage 2, evaluation, report."
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    for group in ("preset", "ablation"):
        names = {path.stem for path in (RECIPES / "config" / group).glob("*.yaml")} - {"none"}
        assert names <= set(re.findall(r"\w+", done.stdout)), group
    assert not list(tmp_path.iterdir())


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_run_says_nothing_more_than_its_tables_unless_it_is_verbose(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import two_stage

    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    capsys.readouterr()
    run(folder, two_stage.two_stage)
    quiet = capsys.readouterr()
    assert quiet.err == ""
    assert quiet.out.splitlines()[-1].startswith("collect 0.")
    run(folder, two_stage.two_stage, "verbose=true")
    told = capsys.readouterr()
    assert told.out.splitlines()[:-1] == quiet.out.splitlines()[:-1]
    for line in (
        f"{folder}: two_stage, preset smoke, seed 0, 1 workers, cpu",
        "bcq lift: goes on from update 12",
        "distillation: goes on from update 12",
        f"{folder / 'evaluation' / 'lift-bcq.csv'}: read back",
        "stage 2: done",
    ):
        assert line in told.err.splitlines()


def test_what_was_imported_is_not_searched_whenever_an_environment_closes(
    recipes: Any, tmp_path: Path
) -> None:
    left_alone: list[int] = []
    gc.unfreeze()
    recipes.run_recipe(
        configured("preset=smoke", f"run_dir={tmp_path}"),
        lambda config: left_alone.append(gc.get_freeze_count()),
    )
    assert left_alone[0] > 100_000


def test_an_episode_has_the_length_of_now_whenever_a_recipe_was_imported(
    recipes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    pytest.importorskip("matplotlib")
    import evaluate
    import interpolate

    from torchrl_bmrl import names

    config = OmegaConf.to_object(configured(*SMALL, f"run_dir={tmp_path}"))
    (tmp_path / "evaluation").mkdir()
    write_results(tmp_path / "evaluation" / "lift-bcq.csv", [])
    monkeypatch.setattr(names, "HORIZON", 7)
    assert interpolate.job_size((config, "prototype")) == 7 * config.interpolation.episodes
    reported: list[int] = []
    evaluate.keep_rows(config, "lift", "bcq", lambda _: [], report=reported.append)
    assert reported == [7 * config.evaluate.episodes]


@pytest.mark.parametrize("preset", ["smoke", "quick", "paper", "literal", "compose"])
def test_every_preset_is_complete_and_valid(recipes: Any, tmp_path: Path, preset: str) -> None:
    config = OmegaConf.to_object(configured(f"preset={preset}", f"run_dir={tmp_path}"))
    recipes.check_settings(config)
    assert config.tasks == ["reach", "lift", "push_right", "push_left", "push_up", "push_down"]


def test_the_presets_differ_in_what_their_names_say(recipes: Any, tmp_path: Path) -> None:
    paper, literal, quick = (
        OmegaConf.to_object(configured(f"preset={preset}", f"run_dir={tmp_path}"))
        for preset in ("paper", "literal", "quick")
    )
    assert list(paper.collect.train_episodes.values()) == [500, 500, 100, 100, 100, 100]
    assert literal.distill.context_fraction == literal.distill.latent_norm_weight == 0.0
    assert literal.distill.encoder_terms == ["classification"]
    assert literal.bcq == quick.bcq
    assert configured(f"run_dir={tmp_path}") == configured("preset=quick", f"run_dir={tmp_path}")


ABLATIONS = sorted(path.stem for path in (RECIPES / "config" / "ablation").glob("*.yaml"))


@pytest.mark.parametrize("ablation", ABLATIONS)
@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_an_ablation_is_valid_and_changes_one_group_of_settings_of_any_preset(
    recipes: Any, tmp_path: Path, preset: str, ablation: str
) -> None:
    plain, config = (
        OmegaConf.to_object(
            configured(f"preset={preset}", f"ablation={name}", f"run_dir={tmp_path}")
        )
        for name in ("none", ablation)
    )
    recipes.check_settings(config)
    assert (config.preset, config.ablation) == (preset, ablation)
    groups = [group for group, value in vars(plain).items() if value != getattr(config, group)]
    if ablation == "none":
        assert not groups
    elif (preset, ablation) == ("paper", "demos_all"):  # what it has anyway
        assert groups == ["ablation"]
    elif ablation == "one_hot":  # acts on a point alone, where the paper preset has three sources
        assert {"ablation", "distill"} <= set(groups) <= {"ablation", "distill", "evaluate"}
    else:
        assert len(groups) == 2


def test_what_each_ablation_takes_away_is_away(recipes: Any, tmp_path: Path) -> None:
    def ablated(name: str) -> Any:
        return OmegaConf.to_object(configured(f"ablation={name}", f"run_dir={tmp_path}"))

    assert ablated("no_direction").distill.direction_weight == 0
    assert ablated("no_isometry").distill.isometry_weight == 0
    assert ablated("detached").distill.encoder_terms == ["classification"]
    assert [ablated(f"dim{n}").distill.task_latent_dim for n in (4, 8)] == [4, 8]
    assert ablated("one_hot").distill.task_encoder == "one_hot"
    assert ablated("perturbation").bcq.perturbation
    assert ablated("latent_clip_none").bcq.latent_clip is None
    assert ablated("candidates_2").bcq.num_candidates == 2
    assert [ablated(f"acting_{n}").evaluate.num_candidates for n in (1, 10)] == [1, 10]
    assert [ablated(f"noise_{n}").collect.noise for n in (0, 40)] == [0.0, 0.4]
    for n in (10, 50, 100):
        assert set(ablated(f"demos_{n}").collect.train_episodes.values()) == {n}
    paper = OmegaConf.to_object(configured("preset=paper", f"run_dir={tmp_path}"))
    assert ablated("demos_all").collect == paper.collect


# -- whole runs ------------------------------------------------------------------------------------


def show_results(folder: Path) -> dict[str, bytes]:
    return contents(folder, "results.csv", "tables/*", "bcq/*/evaluations.csv")


@pytest.mark.robosuite
@pytest.mark.slow
def test_two_stages_from_an_empty_folder_to_the_report_and_again(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    pytest.importorskip("matplotlib")
    overrides = [*SMALL, "bcq.epochs=1", "evaluate.latent_sources=[online]"]
    overrides += ["run_dir=run", "workers=1"]
    done = recipe("two_stage", *overrides, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "report: run/report.html" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    folder = tmp_path / "run"

    with (folder / "results.csv").open() as file:
        assert tuple(csv.DictReader(file).fieldnames or ()) == RESULT_FIELDS
    rows = read_results(folder / "results.csv")
    counts = {
        (task, policy, source): sum(
            (row.task, row.policy, row.latent_source) == (task, policy, source) for row in rows
        )
        for task in ("reach", "lift")
        for policy, source in (("expert", ""), ("bcq", ""), ("distilled", "online"))
    }
    # The expert's rows are its two demonstrations.
    assert list(counts.values()) == [2, 1, 1] * 2
    assert sum(counts.values()) == len(rows)
    assert all(0 < row.episode_return < 600 for row in rows)

    for name in ("results", "table1", "table2", "stages", "goal_distance"):
        assert "lift" in (folder / "tables" / f"{name}.csv").read_text().lower()
        assert "\n| Lift |" in (folder / "tables" / f"{name}.md").read_text()
    page = (folder / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    assert page.count("data:image/png;base64") >= 2
    assert "Explore the embedding" in page
    assert yaml.safe_load((folder / "config.yaml").read_text())["bcq"]["num_cells"] == [16, 16]
    versions = json.loads((folder / "versions.json").read_text())
    assert {"torch", "torchrl", "robosuite", "mujoco", "python", "torchrl_bmrl"} <= set(versions)
    assert set(json.loads((folder / "seconds.json").read_text())) == {
        "collect",
        "stage 1",
        "stage 2",
        "evaluate",
    }
    written = times(folder)
    for path in (
        "data/reach.hdf5",
        "data/lift.hdf5",
        "bcq/reach/checkpoint.safetensors",
        "bcq/lift/checkpoint.safetensors",
        "distill/checkpoint.safetensors",
        "evaluation/lift-distilled-online.csv",
    ):
        assert path in written
    assert list((folder / "logs").rglob("*.csv"))
    assert not [path for path in folder.rglob("*") if path.name.endswith(".tmp")]

    before = show_results(folder)
    done = recipe("two_stage", *overrides, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert times(folder) == written
    assert show_results(folder) == before


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_one_hot_student_learns_from_the_same_agents_and_acts(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    import two_stage

    from torchrl_bmrl.agents import load_student

    folder = run(
        tmp_path / "run",
        two_stage.two_stage,
        "ablation=one_hot",
        "evaluate.latent_sources=[prototype]",
        f"base={finished}",
    )
    assert contents(folder, "data/*.hdf5") == contents(finished, "data/*.hdf5")
    pattern = "bcq/*/checkpoint.safetensors"
    assert contents(folder, pattern) == contents(finished, pattern)
    student, metadata = load_student(folder / "distill" / "checkpoint.safetensors")
    assert student.prototypes.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert metadata["accuracy"] == 1.0
    rows = read_results(folder / "results.csv")
    assert {row.latent_source for row in rows if row.policy == "distilled"} == {"prototype"}
    assert "The figures of the embedding are left out" in (folder / "report.html").read_text()


@pytest.fixture(scope="module")
def exported(run: Run, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run with its exported policy; the former stays as it is for others."""
    import export

    folder = shutil.copytree(finished, tmp_path_factory.mktemp("exported") / "run")
    return run(folder, export.export)


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_policy_of_the_repository_plays_all_tasks_and_knows_its_own_demonstrations(
    run: Run, tmp_path: Path
) -> None:
    import evaluate

    from torchrl_bmrl.agents import load_student
    from torchrl_bmrl.names import TASKS

    policy = RECIPES / "policies" / "sawyer.safetensors"
    assert policy.stat().st_size < 5e6
    card = policy.with_suffix(".md").read_text()
    assert f"evaluate.policy=recipes/policies/{policy.name}" in card
    options = [f"evaluate.policy={policy}", f"run_dir={tmp_path}"]
    config = OmegaConf.to_object(configured(*SMALL, *options))
    student, metadata = load_student(policy)
    statistics = evaluate.ObservationStatistics.from_lists(metadata["statistics"])
    for number, task in enumerate(TASKS):
        episode = evaluate.held_out_episode(config, task, number, statistics)
        points = student.task_encoder(episode)
        logits = student.task_classifier(points)["task_logits"]
        assert (logits.argmax(-1) == number).float().mean() > 0.95
        # Where its expert acted, it acts alike, but for the expert's noise of 0.2.
        acting = student.policy(num_candidates=100, latent_clip=metadata["latent_clip"])
        episode["task_latent"] = student.prototypes[number].expand(len(episode), -1)
        apart = acting(episode.copy())["action"] - episode["action"]
        assert apart.abs().mean() < 0.2
    run(tmp_path, evaluate.evaluate, f"evaluate.policy={policy}", f"tasks=[{','.join(TASKS)}]")
    rows = read_results(tmp_path / "results.csv")
    sources = {"prototype", "online", "demonstration"}
    assert {(row.task, row.latent_source) for row in rows} == {
        (task, source) for task in TASKS for source in sources
    }


@pytest.mark.robosuite
@pytest.mark.slow
def test_an_exported_policy_acts_alone_as_it_does_in_its_run(
    run: Run, exported: Path, tmp_path: Path
) -> None:
    import evaluate

    from torchrl_bmrl.agents import load_student
    from torchrl_bmrl.data.demonstrations import read_statistics
    from torchrl_bmrl.envs.transforms import ObservationStatistics

    policy = shutil.copy(exported / "policy.safetensors", tmp_path)
    kept = ObservationStatistics.from_lists(load_student(Path(policy))[1]["statistics"])
    of_data = read_statistics(exported / "data")
    assert torch.equal(kept.loc, of_data.loc)
    assert torch.equal(kept.scale, of_data.scale)
    alone = run(tmp_path / "alone", evaluate.evaluate, f"evaluate.policy={policy}")
    distilled = [row for row in read_results(exported / "results.csv") if row.latent_source]
    assert read_results(alone / "results.csv") == distilled
    assert not (alone / "data").exists()
    assert str(policy) in (alone / "report.html").read_text()
    card = (exported / "policy.md").read_text()
    assert "1 of reach, 1 of lift" in card
    assert "| Lift | Distilled | online |" in card


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_policy_is_refused_for_a_task_that_it_was_not_trained_on(
    run: Run, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import evaluate

    with pytest.raises(SystemExit, match="1"):
        run(
            tmp_path,
            evaluate.evaluate,
            f"evaluate.policy={exported / 'policy.safetensors'}",
            "tasks=[reach,push_up]",
        )
    said = capsys.readouterr().err
    assert "tasks is ['reach', 'push_up']; valid for" in said
    assert said.endswith("policy.safetensors: ['reach', 'lift']\n")
    assert not (tmp_path / "results.csv").exists()


@pytest.mark.robosuite
@pytest.mark.slow
def test_one_seed_gives_the_same_bytes_in_one_go_and_recipe_by_recipe(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    import collect
    import distill
    import evaluate
    import train_bcq

    for stage in (collect.collect, train_bcq.train_all, distill.distill, evaluate.evaluate):
        run(tmp_path, stage)
    expected = show_results(finished)
    assert len(expected) == 1 + 6 + 2
    assert show_results(tmp_path) == expected
    costly = ("data/*", "**/*.safetensors")
    assert contents(tmp_path, *costly) == contents(finished, *costly)


@pytest.mark.robosuite
@pytest.mark.slow
def test_two_workers_give_the_same_bytes_as_one(finished: Path, tmp_path: Path) -> None:
    search = short_episodes(tmp_path / "patch")
    done = recipe("two_stage", *SMALL, "run_dir=run", "workers=2", cwd=tmp_path, PYTHONPATH=search)
    assert done.returncode == 0, done.stderr
    assert show_results(tmp_path / "run") == show_results(finished)
    checkpoints = contents(finished, "**/*.safetensors")
    assert len(checkpoints) == 2 * 3 + 2
    assert contents(tmp_path / "run", "**/*.safetensors") == checkpoints


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_run_goes_on_with_other_workers_but_not_with_other_settings(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import two_stage

    folder = shutil.copytree(finished, tmp_path / "run")
    before, written = show_results(folder), times(folder)
    with pytest.raises(SystemExit) as caught:
        run(folder, two_stage.two_stage, "bcq.lr=0.1")
    assert caught.value.code == 1
    assert "bcq.lr is 0.1 here and 0.001 in the folder's run" in capsys.readouterr().err
    run(folder, two_stage.two_stage, "workers=2", "logger=none")
    assert times(folder) == written
    assert show_results(folder) == before


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(
    ("update", "kept", "error"),
    # Checkpoints are due after updates 4, 8 and 12, evaluations after 6 and 12.
    [(3, None, KeyboardInterrupt), (7, 4, KeyboardInterrupt), (12, 12, BMRLError)],
)
def test_stage_1_resumed_equals_never_stopped(
    run: Run, finished: Path, tmp_path: Path, update: int, kept: int | None, error: Any
) -> None:
    import train_bcq

    from torchrl_bmrl.checkpoint import load_checkpoint

    shutil.copytree(finished / "data", tmp_path / "data")
    config = OmegaConf.to_object(configured(*SMALL, f"run_dir={tmp_path}"))
    checkpoint = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    with pytest.raises(error):
        train_bcq.train_job((config, {"lift": "lift"}), Interruption(update, error))
    if kept is None:
        assert not checkpoint.exists()
    else:
        assert load_checkpoint(checkpoint, kind="bcq")[1]["updates"] == kept
    counted: list[int] = []
    train_bcq.train_job((config, {"lift": "lift"}), counted.append)
    # What the checkpoint holds is reported at once and not trained again.
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    expected = contents(finished, *LIFT)
    assert len(expected) == 4 + 7
    assert contents(tmp_path, *LIFT) == expected


LIFT = ("bcq/lift/*", "logs/bcq_lift/scalars/*")
"""What stage 1 makes of it: checkpoints (newest, before, best), evaluations; metrics."""


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize("moment", ["write_rows", "Agents.keep_best", "Agents.save"])
def test_stage_1_killed_between_two_files_goes_on_to_the_same_ones(
    run: Run, finished: Path, tmp_path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import train_bcq

    shutil.copytree(finished / "data", tmp_path / "data")
    config = OmegaConf.to_object(configured(*SMALL, f"run_dir={tmp_path}"))
    owner: Any = train_bcq
    *parts, name = moment.split(".")
    for part in parts:
        owner = getattr(owner, part)
    whole, calls = getattr(owner, name), []

    def killed(*arguments: Any) -> None:
        calls.append(arguments)
        if len(calls) == 2:  # at update 12, or 8 of the checkpoints
            raise KeyboardInterrupt
        whole(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, killed)
        with pytest.raises(KeyboardInterrupt):
            train_bcq.train_job((config, {"lift": "lift"}), lambda count: None)
    train_bcq.train_job((config, {"lift": "lift"}), lambda count: None)
    assert contents(tmp_path, *LIFT) == contents(finished, *LIFT)


STACKED = ("bcq.stacked=true", "bcq.seeds=2")
AGENTS = {"reach": "reach", "lift": "lift", "reach-1": "reach", "lift-1": "lift"}


@pytest.fixture(scope="module")
def stacked(run: Run, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stage 1 of two tasks and two seeds in one program, never stopped."""
    import train_bcq

    folder = tmp_path_factory.mktemp("stacked")
    shutil.copytree(finished / "data", folder / "data")
    return run(folder, train_bcq.train_all, *STACKED)


@pytest.mark.robosuite
@pytest.mark.slow
def test_every_member_of_a_stack_has_a_checkpoint_and_curves_of_its_own(stacked: Path) -> None:
    from torchrl_bmrl.agents import load_bcq_loss

    weights = set()
    for name, task in AGENTS.items():
        loss, metadata = load_bcq_loss(stacked / "bcq" / name / "checkpoint.safetensors")
        assert (metadata["task"], metadata["updates"]) == (task, 12)
        weights.add(float(next(loss.generator_params.parameters()).sum()))
        with (stacked / "bcq" / name / "evaluations.csv").open() as file:
            assert [row["update"] for row in csv.DictReader(file)] == ["6", "12"]
        curve = stacked / "logs" / f"bcq_{name}" / "scalars" / "loss_qvalue.csv"
        assert [line.split(",")[0] for line in curve.read_text().splitlines()] == ["4", "8", "12"]
    assert len(weights) == len(AGENTS)


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(("update", "kept"), [(3, None), (7, 4), (12, 12)])
def test_a_stack_resumed_equals_one_never_stopped(
    run: Run, stacked: Path, finished: Path, tmp_path: Path, update: int, kept: int | None
) -> None:
    import train_bcq

    from torchrl_bmrl.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    config = OmegaConf.to_object(configured(*SMALL, *STACKED, f"run_dir={tmp_path}"))
    with pytest.raises(KeyboardInterrupt):
        train_bcq.train_job((config, AGENTS), Interruption(update * len(AGENTS), KeyboardInterrupt))
    member = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    assert member.exists() == (kept is not None)
    if kept is not None:
        assert load_bcq_loss(member)[1]["updates"] == kept
    counted: list[int] = []
    train_bcq.train_job((config, AGENTS), counted.append)
    assert sum(counted) == 12 * len(AGENTS)
    expected = contents(stacked, "bcq/**/*")
    assert len(expected) == 2 + 3 * len(AGENTS)
    assert contents(tmp_path, "bcq/**/*") == expected


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_members_checkpoint_that_a_kill_left_out_is_written_when_the_run_goes_on(
    run: Run, stacked: Path, tmp_path: Path
) -> None:
    import train_bcq

    folder = shutil.copytree(stacked, tmp_path / "run")
    (folder / "bcq" / "lift" / "checkpoint.safetensors").unlink()
    before = times(folder)
    run(folder, train_bcq.train_all, *STACKED)
    assert contents(folder, "bcq/**/*") == contents(stacked, "bcq/**/*")
    assert before.items() <= times(folder).items()  # and nothing else


def diverging(monkeypatch: pytest.MonkeyPatch, factor: Any) -> list[Any]:
    """Multiplies the critics' sixth loss by a factor; returns all losses."""
    import train_bcq

    step, calls = train_bcq.gradient_step, []

    def breaking(optimizer: Any, loss: Any, max_norm: Any) -> None:
        calls.append(loss)  # the generator's and the critics' in turn
        step(optimizer, loss * factor if len(calls) == 2 * 6 else loss, max_norm)

    monkeypatch.setattr(train_bcq, "gradient_step", breaking)
    return calls


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_member_that_diverges_is_named_and_frozen_and_the_others_go_on(
    run: Run,
    stacked: Path,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import train_bcq

    from torchrl_bmrl.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    calls = diverging(monkeypatch, torch.tensor([1.0, float("nan"), 1.0, 1.0]))
    for _ in range(2):  # said again when the command is repeated
        with pytest.raises(SystemExit) as caught:
            run(tmp_path, train_bcq.train_all, *STACKED)
        assert caught.value.code == 1
        says = "bcq lift, update 8: loss_qvalue is nan"
        message = capsys.readouterr().err
        assert f"error: {says}" in message
    assert len(calls) == 2 * 12
    updates = {
        name: load_bcq_loss(tmp_path / "bcq" / name / "checkpoint.safetensors")[1]["updates"]
        for name in AGENTS
    }
    assert updates == {"reach": 12, "lift": 4, "reach-1": 12, "lift-1": 12}
    others = [f"bcq/{name}/*" for name in AGENTS if name != "lift"]
    assert contents(tmp_path, *others) == contents(stacked, *others)


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_single_agent_that_diverges_ends_the_run_with_its_last_checkpoint(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import train_bcq

    from torchrl_bmrl.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    diverging(monkeypatch, float("nan"))
    with pytest.raises(SystemExit):
        run(tmp_path, train_bcq.train_all, "tasks=[lift]")
    assert "error: bcq lift, update 8: loss_qvalue is nan" in capsys.readouterr().err
    path = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    assert load_bcq_loss(path)[1]["updates"] == 4


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++"))), reason="no compiler")
def test_compiled_stages_train_what_eager_ones_do(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import distill
    import train_bcq

    from torchrl_bmrl.checkpoint import load_checkpoint

    for kept in ("data", "bcq/reach", "logs/bcq_reach"):
        shutil.copytree(finished / kept, tmp_path / kept)
    for stage in (train_bcq.train_all, distill.distill):
        run(tmp_path, stage, "compile=true")
    assert "not accelerated" not in capsys.readouterr().err
    for path, kind in (
        ("bcq/lift/checkpoint.safetensors", "bcq"),
        ("distill/checkpoint.safetensors", "student"),
    ):
        compiled, eager = (
            load_checkpoint(folder / path, kind=kind)[0]["module"]
            for folder in (tmp_path, finished)
        )
        for name, value in eager.items():
            torch.testing.assert_close(compiled[name], value, rtol=0, atol=1e-4)


@pytest.mark.robosuite
@pytest.mark.slow
def test_without_a_gpu_captured_stages_say_so_and_train_the_same(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import train_bcq

    from torchrl_bmrl.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    run(tmp_path, train_bcq.train_all, "cudagraphs=true", "tasks=[lift]")
    assert "device=cpu has no CUDA graphs" in capsys.readouterr().err
    for name in ("best", "checkpoint.1", "checkpoint"):  # they say how they were trained
        captured, eager = (
            load_bcq_loss(folder / "bcq" / "lift" / f"{name}.safetensors")[0].state_dict()
            for folder in (tmp_path, finished)
        )
        torch.testing.assert_close(captured, eager, rtol=0, atol=0)
    expected = contents(finished, "bcq/lift/*.csv")
    assert contents(tmp_path, "bcq/lift/*.csv") == expected


def trained(
    finished: Path, folder: Path, *overrides: str
) -> tuple[dict[str, Any], float, set[str]]:
    """What stage 1 trains of lift: its state, the critics' way from their start, what it logs."""
    import train_bcq

    from torchrl_bmrl.agents import make_bcq_loss
    from torchrl_bmrl.checkpoint import load_checkpoint
    from torchrl_bmrl.parallel import derive_seed

    shutil.copytree(finished / "data", folder / "data")
    config = OmegaConf.to_object(configured(*SMALL, f"run_dir={folder}", *overrides))
    train_bcq.train_job((config, {"lift": "lift"}), lambda count: None)
    path = folder / "bcq" / "lift" / "checkpoint.safetensors"
    state, metadata = load_checkpoint(path, kind="bcq")
    torch.manual_seed(derive_seed(config.seed, "bcq", "lift"))
    start = make_bcq_loss(**metadata["loss"]).state_dict()
    way = max(
        float((state["module"][key] - start[key]).abs().max())
        for key in start
        if key.startswith("qvalue_network_params") and key in state["module"]
    )
    return state, way, {path.stem for path in (folder / "logs").rglob("bcq_lift/**/*.csv")}


@pytest.mark.robosuite
@pytest.mark.slow
def test_critics_wait_while_the_generator_warms_up(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    for warmup, waits in ((12, True), (11, False)):
        folder = tmp_path / str(warmup)
        _, way, logged = trained(finished, folder, f"bcq.generator_warmup={warmup}")
        assert (way == 0) == waits
        assert "loss_generator" in logged
        assert ("loss_qvalue" in logged) != waits


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_critics_gradient_is_clipped_and_no_other(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    # Adam divides by the gradient's size but for its epsilon of 1e-8: only a tiny norm shows.
    state, way, _ = trained(finished, tmp_path / "clipped", "bcq.critic_grad_clip=1e-12")
    whole, whole_way, _ = trained(finished, tmp_path / "whole")
    assert way < 1e-4 < whole_way
    generator = [key for key in state["module"] if key.startswith("generator_params")]
    assert all(torch.equal(state["module"][key], whole["module"][key]) for key in generator)


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(("update", "kept"), [(3, None), (6, 4), (12, 12)])
def test_stage_2_resumed_equals_never_stopped(
    run: Run, finished: Path, tmp_path: Path, update: int, kept: int | None
) -> None:
    import distill

    from torchrl_bmrl.checkpoint import load_checkpoint

    for name in ("data", "bcq"):
        shutil.copytree(finished / name, tmp_path / name)
    config = OmegaConf.to_object(configured(*SMALL, f"run_dir={tmp_path}"))
    checkpoint = tmp_path / "distill" / "checkpoint.safetensors"
    with pytest.raises(KeyboardInterrupt):
        distill.train_student(config, Interruption(update, KeyboardInterrupt))
    if kept is None:
        assert not checkpoint.exists()
    else:
        assert load_checkpoint(checkpoint, kind="student")[1]["updates"] == kept
    counted: list[int] = []
    distill.train_student(config, counted.append)
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    # The teachers are as they were, too.
    stages = ("bcq/*/*", "distill/*", "logs/distill/scalars/*")
    assert contents(tmp_path, *stages) == contents(finished, *stages)


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize("damage", ["truncated", "not finite"])
def test_damaged_demonstrations_stop_training_before_anything_is_written(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: str,
) -> None:
    import h5py
    import train_bcq

    shutil.copytree(finished / "data", tmp_path / "data")
    path = tmp_path / "data" / "lift.hdf5"
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:-1000])
    else:
        with h5py.File(path, "r+") as file:
            file["data/demo_0/rewards"][2] = float("nan")
    with pytest.raises(SystemExit) as caught:
        run(tmp_path, train_bcq.train_all, "tasks=[lift]")
    assert caught.value.code == 1
    message = capsys.readouterr().err.splitlines()[-1]
    says = "not a whole HDF5 file" if damage == "truncated" else "not finite in row 2"
    assert message.startswith(f"error: {path}: ")
    assert says in message
    assert not (tmp_path / "bcq").exists()


# -- human demonstrations --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ([], "error: human.path is empty; valid: a robosuite demo.hdf5"),
        (["human.path=nowhere.hdf5"], "error: nowhere.hdf5: no such file"),
        (["human.path=a", "human.shares=[0.1]"], "error: human.shares is [0.1]; valid: 0 and"),
        (["human.path=a", "human.shares=[0,1.5]"], "error: human.shares is [0.0, 1.5]; valid"),
        (["human.path=a", "human.tracking=0"], "error: human.tracking is 0.0; valid: above 0"),
    ],
)
def test_learning_from_people_names_what_is_missing(
    run: Run, tmp_path: Path, overrides: list[str], says: str, capsys: Any
) -> None:
    import learn_from_people

    with pytest.raises(SystemExit, match="1"):
        run(tmp_path, learn_from_people.learn_from_people, *overrides)
    said = capsys.readouterr().err
    assert says in said
    assert "Traceback" not in said


def test_the_verdict_on_people_s_data_follows_from_the_interval(recipes: Any) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    import learn_from_people

    def rows(share: float, gain: float, noise: float) -> list[dict[str, Any]]:
        return [
            {
                "share": share,
                "training_seed": i % 2,
                "return": 100 + i + gain + noise * (-1) ** (i // 2),
                "success": i % 2,
            }
            for i in range(20)
        ]

    table = learn_from_people.comparison(
        rows(0, 0, 0) + rows(0.1, 5, 1) + rows(0.2, -5, 1) + rows(0.3, 0.1, 5), [0, 0.1, 0.2, 0.3]
    ).splitlines()
    assert table[2] == "| 0% | 109.5 | 10 of 20 | | |"
    assert [line.split("|")[-2].strip() for line in table[3:6]] == [
        "helped",
        "hurt",
        "no difference to be seen",
    ]
    assert "+5.0 (" in table[3]
    few = learn_from_people.comparison(rows(0, 0, 0)[:4] + rows(0.1, 5, 1)[:4], [0, 0.1])
    assert "too few episodes" in few


@pytest.mark.robosuite
@pytest.mark.slow
def test_learning_from_people_compares_every_share_and_goes_on(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import learn_from_people

    # Any file in robomimic's layout with the task's observation may stand for people's.
    options = [
        f"human.path={finished / 'data' / 'lift.hdf5'}",
        "human.shares=[0,1]",
        "human.training_seeds=1",
        "evaluate.episodes=2",
    ]
    run(tmp_path, learn_from_people.learn_from_people, *options)
    table = (tmp_path / "tables" / "human.md").read_text()
    assert [line.split("|")[1].strip() for line in table.splitlines()[2:4]] == ["0%", "100%"]
    assert "0 of 2" in table
    assert "too few episodes" in table
    assert table in capsys.readouterr().out
    with (tmp_path / "human.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["share"] for row in rows] == ["0.0", "0.0", "1.0", "1.0"]
    before = times(tmp_path)
    run(tmp_path, learn_from_people.learn_from_people, *options)
    assert times(tmp_path) == before

    # What the agents trained on: ten scripted transitions, then the human ones.
    buffers: list[Any] = []
    monkeypatch.setattr(learn_from_people, "train_agents", lambda *given: buffers.append(given[2]))
    config = OmegaConf.to_object(configured(*SMALL, f"run_dir={tmp_path}"))
    for share in (0.0, 1.0):
        learn_from_people.train_job((config, share, 0), lambda _: None)
    scripted, human = (buffer.sample()["index"] for buffer in buffers)
    assert scripted.max() < HORIZON <= human.min()


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
