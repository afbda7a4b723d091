"""What a command gives and what its run's folder knows; nothing is left of a command that fails."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

import yaml
from small_runs import RECIPES, SMALL, command_line, configured, contents, settings_of, started

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.pipeline import Run
from torchrl_bmrl.run.folder import open_run, read_settings
from torchrl_bmrl.run.locks import lock, lock_run

MADE = ("preset=paper", "ablation=dim4", "seed=3", "bcq.lr=1e-4")
MADE += ("+collect.after.lift=['',reach]", "+collect.experts.lift=[{},{noise:0.5}]")
MADE += ("workers=7", "verbose=true", "device=cuda")


@pytest.fixture
def made(recipes: Any, tmp_path: Path) -> Path:
    """The folder of a run with settings of its own and of a study, nothing in it yet."""
    folder = tmp_path / "made"
    run = Run(settings_of(*MADE, f"run_dir={folder}"))
    open_run(folder, asdict(run.settings) | {"imitate": {"episodes": 10}})
    return folder


STUDIES = ("export", "evaluate", "imitate", "interpolate", "latent_sac")


# -- the folder's settings -------------------------------------------------------------------------


@pytest.mark.parametrize("name", STUDIES)
def test_a_command_on_a_run_takes_what_it_does_not_give_from_the_folder(
    recipes: Any, made: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    before = contents(made, "*")
    code, (config, *study) = started(recipes, name, f"run_dir={made}", "workers=2")
    assert code == 0
    assert (config.preset, config.ablation, config.seed) == ("paper", "dim4", 3)
    assert config.collect.train_episodes["lift"] == 500
    assert config.collect.after == {"lift": ["", "reach"]}
    assert config.collect.experts == {"lift": [{}, {"noise": 0.5}]}
    assert config.bcq.lr == 1e-4
    assert config.evaluate.episodes == 50
    if name == "imitate":
        assert study[0].episodes == 10  # a study's own are the folder's, too
    # This machine's and this command's are not; nor does this one need what trained.
    assert (config.workers, config.verbose, config.run_dir) == (2, False, str(made))
    assert config.device == "cuda"
    assert contents(made, "*") == before
    said = f"{made}: other settings are read from its config.yaml\n"
    assert capsys.readouterr().err.endswith(said)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["bcq.lr=1e-3"], "bcq.lr is 0.001 here and 0.0001 in the folder's run"),
        (["bcq={lr:1e-3}"], "bcq.lr is 0.001 here and 0.0001 in the folder's run"),
        (["seed=0"], "seed is 0 here and 3 in"),
        (["preset=quick"], "preset is quick here and paper in the folder's run"),
        (["ablation=dim8"], "ablation is dim8 here and dim4 in the folder's run"),
        (["ablation=none"], "ablation is none here and dim4 in the folder's run"),
        (["evaluate.episodes=20"], "evaluate.episodes is 20 here and 50 in"),
        (["~collect.after"], "does not support deletion"),
        (["device=gpu"], "device is gpu here and cuda in"),
    ],
)
def test_what_a_command_gives_and_differs_is_refused(
    recipes: Any,
    made: Path,
    overrides: list[str],
    says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    before = contents(made, "**/*")
    code, ran = started(recipes, "export", f"run_dir={made}", *overrides)
    assert (code, ran) == (1, [])
    assert says in capsys.readouterr().err
    assert contents(made, "**/*") == before
    assert [path.name for path in made.parent.iterdir()] == ["made"]


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["preset=paper"], {}),
        (["preset=paper", "ablation=dim4", "seed=3"], {}),
        (["bcq.lr=1e-4", "checkpoint_interval=7"], {"checkpoint_interval": 7}),
        (["evaluate={episodes:50}"], {"evaluate.episodes": 50, "evaluate.num_candidates": 100}),
        (["logger=none"], {"logger": "none"}),
    ],
)
def test_what_a_command_repeats_or_may_change_is_as_given(
    recipes: Any, made: Path, overrides: list[str], expected: dict[str, Any]
) -> None:
    from omegaconf import OmegaConf

    pytest.importorskip("robosuite", exc_type=ImportError)
    code, (config,) = started(recipes, "evaluate", f"run_dir={made}", *overrides)
    assert code == 0
    assert (config.seed, config.bcq.lr, config.distill.task_latent_dim) == (3, 1e-4, 4)
    settings = OmegaConf.structured(config)
    assert {key: OmegaConf.select(settings, key) for key in expected} == expected


def test_a_training_command_needs_the_runs_device(
    recipes: Any, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one")
    pytest.importorskip("robosuite", exc_type=ImportError)
    assert started(recipes, "distill", f"run_dir={made}") == (1, [])
    assert "device is 'cuda'; valid: one that torch can use" in capsys.readouterr().err


def test_a_folder_that_was_not_given_is_compared_and_not_taken_over(
    recipes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    monkeypatch.chdir(tmp_path)
    assert started(recipes, "collect", "bcq.lr=0.5")[0] == 0
    assert started(recipes, "collect") == (1, [])
    assert "bcq.lr is 0.003 here and 0.5 in the folder's run" in capsys.readouterr().err
    assert started(recipes, "collect", "run_dir=runs/collect-quick-seed0")[0] == 0


@pytest.mark.parametrize(
    ("overrides", "folder"),
    [
        ([], "runs/train_bcq-quick-seed0"),
        (["preset=smoke", "seed=3"], "runs/train_bcq-smoke-seed3"),
        (["ablation=dim4"], "runs/train_bcq-quick-dim4-seed0"),
    ],
)
def test_runs_of_other_seeds_and_presets_have_folders_of_their_own(
    recipes: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    overrides: list[str],
    folder: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, (config,) = started(recipes, "train_bcq", *overrides)
    assert (code, config.run_dir) == (0, folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("bcq.lr", "fast"),
        ("bcq.lr", None),
        ("bcq", 3),
        ("tasks", "${oc.env:HOME}"),
        ("evaluate.policy", "${oc.env:HOME}"),
        ("bcq.lrr", 1),
        ("collect.train_episodes", []),
    ],
)
def test_settings_of_a_folder_that_are_none_are_refused_by_their_name(
    recipes: Any, made: Path, key: str, value: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    settings = read_settings(made)
    group, _, name = key.rpartition(".")
    (settings[group] if group else settings)[name] = value
    (made / "config.yaml").write_text(yaml.safe_dump(settings))
    code, ran = started(recipes, "export", f"run_dir={made}")
    assert (code, ran) == (1, [])
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: ")
    assert f"{key}" in said
    assert os.environ["HOME"] not in said.replace(str(made), "")


@pytest.mark.robosuite
@pytest.mark.slow
def test_studies_of_a_finished_run_need_its_folder_alone(
    run: Any, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("onnxscript")
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    results = contents(folder, "results.csv", "distill/*", "config.yaml")
    for name in ("evaluate", "export"):
        assert command_line(name, f"run_dir={folder}") == 0
    assert contents(folder, "results.csv", "distill/*", "config.yaml") == results
    card = (folder / "policy.md").read_text()
    assert card.startswith("# The distilled policy of preset smoke, seed 0")


# -- texts -----------------------------------------------------------------------------------------

NUMBERS = ["1.10", "007", "1e3", "true", "True", "2026-11-28", "1_000", "NaN", "-1", "+1", "1."]


@pytest.mark.parametrize("name", [*NUMBERS, "0x10", "a b", "off", "-0", "1,1"[:1], "'1.10'"])
def test_a_run_lies_in_the_folder_that_was_typed(
    recipes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, (config,) = started(recipes, "train_bcq", f"run_dir={name}", f"evaluate.policy={name}")
    typed = name.strip("'")
    assert (code, config.run_dir, config.evaluate.policy) == (0, typed, typed)
    assert [path.name for path in tmp_path.iterdir()] == [typed]
    assert read_settings(tmp_path / typed)["run_dir"] == typed


def test_a_folder_whose_name_is_a_number_knows_its_settings_too(
    recipes: Any, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(made.rename(made.with_name("1.10")).parent)
    pytest.importorskip("robosuite", exc_type=ImportError)
    code, (config,) = started(recipes, "evaluate", "run_dir=1.10")
    assert (code, config.seed, config.run_dir) == (0, 3, "1.10")


@pytest.mark.parametrize("name", ["", "null", "[1.10]", "{a:1}", "1.10,2.0"])
def test_what_is_no_folder_is_refused(
    recipes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert started(recipes, "train_bcq", f"run_dir={name}") == (1, [])
    assert "run_dir" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "typed"),
    [
        ("only=[1.10, lift,'1.0']", "only=['1.10', lift,'1.0']"),
        ("run_dir=1.10,a,2.0", "run_dir='1.10',a,'2.0'"),
        ("run_dir=choice(1.10,1.0)", "run_dir=choice('1.10','1.0')"),
        ("only=[1.0],[lift]", "only=['1.0'],[lift]"),
        ("base=1e3", "base='1e3'"),
        ("base=null", "base=null"),
        ("evaluate.policy=1.0", "evaluate.policy='1.0'"),
        ("bcq.lr=1e-3,1e-4", "bcq.lr=1e-3,1e-4"),
        ("bcq.value_bounds=[1.0,2.0]", "bcq.value_bounds=[1.0,2.0]"),
        ("verbose=true", "verbose=true"),
        ("seed=range(1,3)", "seed=range(1,3)"),
        ("run_dir=runs/${seed}/1.10", "run_dir=runs/${seed}/1.10"),
        ("~collect.after", "~collect.after"),
        ("+collect.train_episodes.lift=3", "+collect.train_episodes.lift=3"),
    ],
)
def test_texts_get_quotes_and_nothing_else(recipes: Any, line: str, typed: str) -> None:
    from hydra_plugins.as_typed import as_typed

    assert as_typed(line, configured()) == typed


# -- nothing is left -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("train_bcq", []),
        ("train_bcq", ["only=[lift]"]),
        ("distill", []),
        ("evaluate", []),
        ("export", []),
        ("imitate", ["imitate.composition=reach-lift", "tasks=[reach]"]),
        ("imitate", []),
        ("interpolate", ["tasks=[lift]"]),
        ("interpolate", []),
        ("latent_sac", []),
        ("fqe", []),
        ("baselines", []),
        ("learn_from_people", []),
        ("learn_from_people", ["human.path=nothing.hdf5"]),
        ("two_stage", ["base=nothing"]),
        ("collect", ["bcq.lr=-1"]),
    ],
)
def test_a_command_that_fails_before_it_did_anything_leaves_nothing(
    recipes: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    overrides: list[str],
) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    pytest.importorskip("onnxscript")
    monkeypatch.chdir(tmp_path)
    options = ["preset=smoke", "run_dir=runs/deep/mine", "workers=1", *overrides]
    assert command_line(name, *options) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def failing(run_dir: Path, names: Sequence[str] = ("run",), do: Any = lambda: None) -> None:
    with lock_run(run_dir, {"seed": 0}, names):
        do()
        raise FileNotFoundError("demonstrations")


def test_what_was_done_stays_and_so_does_what_was_there(tmp_path: Path) -> None:
    done = tmp_path / "done"
    with pytest.raises(FileNotFoundError):
        failing(done, do=lambda: (done / "data.hdf5").touch())
    assert {path.name for path in done.iterdir()} == {
        "config.yaml",
        "versions.json",
        ".locks",
        "data.hdf5",
    }
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").touch()
    with pytest.raises(FileNotFoundError):
        failing(mine)
    assert [path.name for path in mine.iterdir()] == ["notes.txt"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError):
        failing(tmp_path / "empty", do=(tmp_path / "empty" / "logs").mkdir)
    assert list((tmp_path / "empty").iterdir()) == []


def test_a_folder_that_others_hold_a_part_of_stays_theirs(tmp_path: Path) -> None:
    folder = tmp_path / "run"

    def come() -> None:
        others.__enter__()

    others = lock(folder, ["lift"])
    with pytest.raises(FileNotFoundError):
        failing(folder, ["reach"], come)
    assert (folder / "config.yaml").exists()
    assert (folder / ".locks" / "lift.json").exists()
    others.__exit__(None, None, None)


def test_another_runs_folder_gets_no_locks_of_a_command_that_is_refused(tmp_path: Path) -> None:
    open_run(tmp_path / "run", {"seed": 7})
    before = contents(tmp_path, "**/*")
    with pytest.raises(ConfigError, match="seed is 0 here and 7"):
        failing(tmp_path / "run")
    assert contents(tmp_path, "**/*") == before
    assert not (tmp_path / "run" / ".locks").exists()


def test_every_recipe_runs_in_a_folder_that_knows_its_settings() -> None:
    mains = [path for path in RECIPES.glob("*.py") if "@hydra.main" in path.read_text()]
    assert len(mains) > 11
    for path in mains:
        text = path.read_text()
        assert "run_recipe(" in text or "with_folders_settings(" in text


def test_small_runs_settings_are_the_commands_own_without_a_command_line(
    recipes: Any, tmp_path: Path
) -> None:
    """In code nothing is taken over: what is passed is what is compared."""
    open_run(tmp_path, {"seed": 5})
    settings = configured(*SMALL, f"run_dir={tmp_path}")
    assert recipes.with_folders_settings(settings) is settings
