"""The script that publishes: what it takes from run folders, and the command of a run."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import csv
import json
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

for extra in ("hydra", "h5py", "robosuite", "safetensors", "scipy", "matplotlib", "sklearn"):
    pytest.importorskip(extra)

import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from published_data import make_rows
from small_runs import RECIPES

# isort: split
from published import TASKS, read_published

from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.evaluation import ResultRow, write_results
from torchrl_bmrl.rows import write_rows
from torchrl_bmrl.training.checkpoint import save_checkpoint
from torchrl_bmrl.training.diagnostics import Diagnostics, write_diagnostics


@pytest.fixture
def publish() -> Iterator[Any]:
    """The script's module."""
    with (
        pytest.MonkeyPatch.context() as patch,
        initialize_config_dir(str(RECIPES / "config"), version_base="1.3"),
    ):
        patch.syspath_prepend(str(RECIPES))
        import command  # noqa: F401 -- registers the schema of recipe.yaml
        import publish

        yield publish


def make_settings(*overrides: str) -> dict[str, Any]:
    """What ``config.yaml`` holds of a run with these overrides."""
    config = compose("recipe", [*overrides, "run_dir=runs/a"])
    return OmegaConf.to_container(config, resolve=False)


def rows_of(seed: int, *policies: str) -> list[ResultRow]:
    return [row for row in make_rows(seed, episodes=2) if row.policy in policies]


def make_folder(path: Path, *overrides: str, seed: int = 3) -> Path:
    """A small finished run."""
    settings = make_settings(*overrides, f"seed={seed}")
    path.mkdir()
    (path / "config.yaml").write_text(yaml.safe_dump(settings))
    (path / "versions.json").write_text(json.dumps({"torch": "2.13", "commit": "abc"}))
    (path / "seconds.json").write_text(json.dumps({"collect": 30.0, "stage 1": 60.0}))
    write_results(path / "results.csv", rows_of(seed, "expert", "bcq"))
    metadata = {"kind": "student", "accuracy": 0.987654321, "student": {"task_latent_dim": 4}}
    (path / "distill").mkdir()
    save_checkpoint(path / "distill" / "checkpoint.safetensors", {"a": torch.ones(1)}, metadata)
    for task in TASKS:
        curve = [{"epoch": 1, "update": 9, "episode": 0, "return": 1 / 3, "success": 1}]
        write_rows(path / "bcq" / task / "evaluations.csv", curve)
    return path


def add_baselines(folder: Path, seed: int = 3, **coefficients: dict[str, float]) -> list[ResultRow]:
    """Adds evaluated baselines, by algorithm, with the coefficients of their checkpoints."""
    rows = [replace(row, policy=name) for name in coefficients for row in rows_of(seed, "bcq")]
    write_results(folder / "baselines.csv", rows)
    for name, given in coefficients.items():
        metadata = {"kind": "baseline", "coefficients": given} if given else {"kind": "baseline"}
        for task in TASKS:
            path = folder / "baselines" / f"{name}-{task}" / "checkpoint.safetensors"
            save_checkpoint(path, {"a": torch.ones(1)}, metadata)
    return rows


def test_a_folder_becomes_rows(publish: Any, tmp_path: Path) -> None:
    run_dir = make_folder(tmp_path / "run", "preset=paper")
    baselines = add_baselines(run_dir, bc={}, iql={"expectile": 0.7, "temperature": 3.0})
    docs = tmp_path / "docs"
    publish.publish([run_dir], docs)
    published = read_published(docs / "results")
    (run,) = published.runs
    assert run.key == ("paper", "none", 3)
    assert run.command == "python recipes/two_stage.py preset=paper seed=3"
    assert (run.commit, run.versions) == ("abc", "torch 2.13")
    assert (run.accuracy, run.task_latent_dim) == (0.98765, 4)
    assert (run.seconds_stage_1, run.seconds_stage_2) == (60.0, None)
    assert {e.row for e in published.episodes} == set(rows_of(3, "expert", "bcq") + baselines)
    assert [(c.task, c.seed, c.episode_return) for c in published.curves] == [
        (task, 3, 0.333) for task in TASKS
    ]
    publish.check_results_page(docs)


def test_baselines_with_other_coefficients_are_named_by_them(publish: Any, tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    run_dir = make_folder(tmp_path / "run", "preset=weak_paper")
    tuned = make_folder(tmp_path / "tuned", "preset=weak_paper")
    add_baselines(run_dir, iql={}, rebrac={"actor_penalty": 1.0})
    add_baselines(tuned, iql={"expectile": 0.5, "temperature": 3.0})
    publish.publish([run_dir], docs, baselines=[tuned])
    policies = {e.row.policy for e in read_published(docs / "results" / "weak").episodes}
    named = {"iql", "IQL (expectile 0.5)", "ReBRAC (actor_penalty 1)"}
    assert policies == {"expert", "bcq", *named}
    publish.check_weak_page(docs)


@pytest.mark.parametrize(
    ("seed", "given", "says"),
    [
        (4, {"expectile": 0.5}, r"tuned belongs to run \('weak_paper', 'none', 4\)"),
        (3, {}, "policy: 'iql' is in .*run or another folder, too"),
    ],
)
def test_baselines_of_no_run_and_those_that_are_there_already_are_refused(
    publish: Any, tmp_path: Path, seed: int, given: dict[str, float], says: str
) -> None:
    run_dir = make_folder(tmp_path / "run", "preset=weak_paper")
    tuned = make_folder(tmp_path / "tuned", "preset=weak_paper", seed=seed)
    add_baselines(run_dir, iql={})
    add_baselines(tuned, seed, iql=given)
    with pytest.raises(BMRLError, match=says):
        publish.publish([run_dir], tmp_path / "docs", baselines=[tuned])
    assert not (tmp_path / "docs").exists()


def test_baselines_of_a_run_without_an_evaluation_are_refused(publish: Any, tmp_path: Path) -> None:
    run_dir = stage_1_folder(tmp_path / "run", "preset=weak", "ablation=dim4")
    tuned = make_folder(tmp_path / "tuned", "preset=weak", "ablation=dim4")
    add_baselines(tuned, iql={"expectile": 0.5})
    with pytest.raises(ConfigError, match="published with it and was evaluated"):
        publish.publish([run_dir], tmp_path / "docs", baselines=[tuned])


def test_a_baseline_without_its_checkpoint_is_refused(publish: Any, tmp_path: Path) -> None:
    run_dir = make_folder(tmp_path / "run", "preset=paper")
    add_baselines(run_dir, iql={})
    shutil.rmtree(run_dir / "baselines")
    with pytest.raises(BMRLError, match="iql-reach"):
        publish.publish([run_dir], tmp_path / "docs")


@pytest.mark.slow
def test_publishing_again_changes_nothing(publish: Any, tmp_path: Path) -> None:
    runs = [make_folder(tmp_path / str(s), "preset=paper", seed=s) for s in (1, 2)]
    docs = tmp_path / "docs"

    def published(order: list[Path]) -> dict[Path, bytes]:
        publish.publish(order, docs)
        return {path: path.read_bytes() for path in docs.rglob("*") if path.is_file()}

    first = published(runs)
    assert published(runs[::-1]) == published(runs[:1]) == published([]) == first


@pytest.mark.parametrize(
    "overrides",
    [
        ["preset=paper"],
        ["preset=quick", "bcq.lmbda=0.9"],
        ["preset=paper", "ablation=demos_10", "distill.updates=7"],
        ["preset=literal", "distill.encoder_terms=[generator,qvalue]", "bcq.latent_clip=null"],
        ["preset=compose", "tasks=[lift,reach]", "collect.gains.position=3.0", "bcq.stacked=true"],
    ],
)
def test_the_command_of_a_run_gives_its_settings(publish: Any, overrides: list[str]) -> None:
    settings = make_settings(*overrides, "seed=5", "workers=1")
    python, recipe, *words = shlex.split(publish.command_of(settings))
    assert (python, recipe) == ("python", "recipes/two_stage.py")
    assert len(words) == len(overrides) + 1  # and the seed
    again = make_settings(*words)
    assert again | {"workers": 1} == settings


@pytest.mark.parametrize(
    ("kind", "name", "says"),
    [
        ("preset", "huge", r"preset is huge in the run; valid: compose, .*quick"),
        ("preset", None, r"preset is None in the run; valid: compose, .*quick"),
        ("ablation", "all", r"ablation is all in the run; valid: acting_1, .*none"),
    ],
)
def test_a_run_of_no_preset_or_ablation_that_there_is_has_no_command(
    publish: Any, kind: str, name: str | None, says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        publish.command_of(make_settings("preset=quick") | {kind: name})


def test_a_setting_that_is_gone_is_named(publish: Any) -> None:
    settings = make_settings()
    with pytest.raises(ConfigError, match=r"bcq\.magic is a setting of the run"):
        publish.command_of(settings | {"bcq": {**settings["bcq"], "magic": 1}})


def broken(path: Path, name: str, content: str | None) -> None:
    (path / name).unlink() if content is None else (path / name).write_text(content)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("config.yaml", None),
        ("versions.json", None),
        ("results.csv", None),
        ("distill/checkpoint.safetensors", None),
        ("seconds.json", "{"),
        ("bcq/lift/evaluations.csv", "epoch,update\n"),
    ],
)
def test_a_damaged_folder_leaves_what_was_published(
    publish: Any, tmp_path: Path, name: str, content: str | None
) -> None:
    docs = tmp_path / "docs"
    good = make_folder(tmp_path / "good", "preset=paper", seed=1)
    publish.publish([good], docs)
    before = {p: p.read_bytes() for p in docs.rglob("*") if p.is_file()}
    bad = make_folder(tmp_path / "bad", "preset=paper", seed=2)
    broken(bad, name, content)
    with pytest.raises(BMRLError, match=name):
        publish.publish([bad], docs)
    assert {p: p.read_bytes() for p in docs.rglob("*") if p.is_file()} == before


def stage_1_folder(path: Path, *overrides: str) -> Path:
    """A run of stage 1 alone, of two epochs."""
    run_dir = make_folder(path, *overrides, "bcq.epochs=2")
    (run_dir / "results.csv").unlink()
    shutil.rmtree(run_dir / "distill")
    found = {"qvalue_gap": 1.0, "qvalue_std": 2.0, "outside_share": 0.1, "latent_kl": None}
    for task in TASKS:
        curve = [
            {"epoch": epoch, "update": epoch, "episode": 0, "return": 10.0 * epoch, "success": 1}
            for epoch in (1, 2)
        ]
        write_rows(run_dir / "bcq" / task / "evaluations.csv", curve)
        for epoch in (1, 2):
            numbers = Diagnostics(candidate_spread=0.1, spread_ratio=epoch / 3, **found)  # type: ignore[arg-type]
            path = run_dir / "bcq" / task / "diagnostics.csv"
            write_diagnostics(path, numbers, epoch=epoch, update=epoch)
    return run_dir


def test_weak_runs_have_a_folder_and_a_page_of_their_own(publish: Any, tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    (page,) = publish.publish([make_folder(tmp_path / "a", "preset=quick")], docs)
    before = {p: p.read_bytes() for p in docs.rglob("*") if p.is_file()}
    runs = [
        make_folder(tmp_path / "main", "preset=weak_paper"),
        stage_1_folder(tmp_path / "change", "preset=weak", "ablation=dim4"),
    ]
    assert publish.publish(runs, docs) == [page, docs / "weak.md"]
    for path, content in before.items():
        assert path.read_bytes() == content
    published = read_published(docs / "results" / "weak")
    main, change = published.runs
    assert main.key == ("weak_paper", "none", 3)
    assert change.key == ("weak", "dim4", 3)
    assert change.command == (
        "python recipes/train_bcq.py preset=weak ablation=dim4 seed=3 bcq.epochs=2"
    )
    assert (change.accuracy, change.task_latent_dim) == (None, 4)
    assert {e.key for e in published.episodes} == {main.key}
    curves = [c for c in published.curves if c.key == change.key]
    assert [(c.task, c.epoch, c.episode_return) for c in curves] == [(t, 2, 20.0) for t in TASKS]
    assert [(d.task, d.update, d.spread_ratio, d.relative_gap) for d in published.diagnostics] == [
        (task, 2, 0.6667, 0.5) for task in TASKS
    ]
    publish.check_weak_page(docs)


@pytest.mark.parametrize(
    ("overrides", "epochs", "says"),
    [
        (["preset=weak_paper"], 2, "checkpoint.safetensors"),
        (["preset=quick", "ablation=dim4"], 2, "checkpoint.safetensors"),
        (["preset=weak", "ablation=dim4"], 1, r"push_up.evaluations\.csv.*the last is 1; valid: 2"),
        (["preset=weak", "ablation=dim4"], 0, r"push_up.evaluations\.csv"),
    ],
)
def test_only_finished_changes_of_weak_runs_may_have_stage_1_alone(
    publish: Any, tmp_path: Path, overrides: list[str], epochs: int, says: str
) -> None:
    run_dir = stage_1_folder(tmp_path / "run", *overrides)
    path = run_dir / "bcq" / "push_up" / "evaluations.csv"
    if epochs:
        path.write_text("".join(path.read_text().splitlines(keepends=True)[: epochs + 1]))
    else:
        path.unlink()
    with pytest.raises(BMRLError, match=says):
        publish.publish([run_dir], tmp_path / "docs")
    assert not (tmp_path / "docs").exists()


def test_a_change_may_be_measured_on_some_of_the_tasks(publish: Any, tmp_path: Path) -> None:
    tasks = ["lift", "push_right"]
    run_dir = stage_1_folder(
        tmp_path / "run", "preset=weak", "ablation=dim4", f"tasks=[{','.join(tasks)}]"
    )
    for task in set(TASKS) - set(tasks):
        shutil.rmtree(run_dir / "bcq" / task)
    publish.publish([run_dir], tmp_path / "docs")
    published = read_published(tmp_path / "docs" / "results" / "weak")
    assert [c.task for c in published.curves] == tasks
    assert f"'tasks={json.dumps(tasks)}'" in published.runs[0].command


def test_episodes_of_another_seed_are_refused(publish: Any, tmp_path: Path) -> None:
    run_dir = make_folder(tmp_path / "run", "preset=paper")
    rows = [replace(row, seed=8) for row in rows_of(3, "expert", "bcq")]
    write_results(run_dir / "results.csv", rows)
    with pytest.raises(DataError, match="seed: 8; the run's is 3"):
        publish.publish([run_dir], tmp_path / "docs")


@pytest.mark.slow
def test_the_check_exits_with_one_line_when_a_number_was_changed(
    publish: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    docs = tmp_path / "docs"
    run_dir = make_folder(tmp_path / "run", "preset=quick")

    def command(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["publish.py", *words, f"--docs={docs}"])
        try:
            publish.main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    assert command(str(run_dir)) == 0
    assert command("--check") == 0
    path = docs / "results" / "runs.csv"
    with path.open(newline="") as file:
        (row,) = csv.DictReader(file)
    write_rows(path, [row | {"seconds_collect": "999.0"}])
    capsys.readouterr()
    assert command("--check") == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert said.startswith(f"error: {docs / 'results.md'}: line ")
