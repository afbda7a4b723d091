"""The recipes' command lines: errors, help, presets, ablations."""

from __future__ import annotations

import ast
import gc
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import RECIPES, command_line, configured, make_run, recipe, settings_of

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation import ResultRow, write_results
from torchrl_bmrl.pipeline import Run, Settings


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["preset=smoke", "bcq.lrr=1"], ["bcq.lrr", "BCQSettings"]),
        (["preset=smoke", "bcq.lr=abc"], ["bcq.lr", "'abc'", "Float"]),
        (["preset=smoke", "tasks=[lfit]"], ["error: unknown task 'lfit'", "reach, lift, push_r"]),
        (["preset=fast"], ["preset/fast", "compose", "mixed", "paper", "quick", "weak"]),
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
    assert list(tmp_path.iterdir()) == []


def check(settings: Settings) -> Run:
    """What a command checks before it opens the folder."""
    settings.check()
    return Run(settings)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("tasks=[]", r"tasks is \[\]"),
        ("tasks=[lift,lift]", "each once"),
        ("only=[]", r"only is \[\]; valid: some of .'reach', 'lift'"),
        ("only=[lift,lift]", "only is .'lift', 'lift'.; valid: .*each once"),
        ("only=[lfit]", "only is .'lfit'.; valid: some of .'reach', 'lift'"),
        ("+collect.train_episodes.lfit=1", "unknown task 'lfit'"),
        ("+collect.after.lfit=[reach]", "unknown task 'lfit'"),
        ("+collect.after.lift=['',reach-lfit]", "unknown task 'lfit'"),
        ("collect.train_episodes.lift=0", "collect.train_episodes.lift is 0; valid: above 0"),
        ("collect.valid_episodes=0", "collect.valid_episodes"),
        ("evaluate.latent_sources=[]", r"evaluate.latent_sources is \[\]"),
        ("evaluate.latent_sources=[mean]", "'mean'; .*prototype, online, demonstration"),
        ("distill.context=next", "distill.context 'next'; .*current, previous, random, set"),
        ("distill.task_encoder=two_hot", "distill.task_encoder 'two_hot'; .*transition, .*one_hot"),
        ("distill.task_encoder=one_hot", "isometry_weight is 1.0; .*task_encoder=one_hot: 0"),
        ("distill.prototype=mode", "distill.prototype 'mode'; .*mean, medoid"),
        ("bcq.loss_function=l3", "bcq.loss_function 'l3'; .*l2, l1, smooth_l1"),
        ("bcq.kl_reduction=max", "bcq.kl_reduction 'max'; .*mean, sum"),
        ("bcq.lmbda=1.5", "bcq.lmbda is 1.5; valid: at least 0 and at most 1"),
        ("bcq.generator_warmup=-1", "bcq.generator_warmup is -1; valid: at least 0"),
        ("bcq.critic_grad_clip=0", "bcq.critic_grad_clip is 0.0; valid: above 0"),
        ("bcq.value_bounds=[1,0]", r"value_bounds are .1.0, 0.0.; valid: .*low < high"),
        ("distill.encoder_terms=[critic]", "distill.encoder_terms 'critic'; .*qvalue, metric"),
        ("distill.metric_weight=-1", "distill.metric_weight is -1.0; valid: at least 0"),
        ("distill.isometry_weight=-1", "distill.isometry_weight is -1.0; valid: at least 0"),
        ("workers=0", "workers is 0"),
        ("bcq.lr=0", "bcq.lr is 0"),
        ("bcq.seeds=0", "bcq.seeds is 0"),
        (("only=[lift]", "bcq.stacked=true"), "only is .*; valid with bcq.stacked: null"),
        ("device=gpu", "device is 'gpu'; valid: one that torch can use"),
        ("bcq.eval_episodes=-1", "bcq.eval_episodes is -1"),
        ("evaluate.episodes=-1", "evaluate.episodes is -1"),
        ("checkpoint_interval=0", "checkpoint_interval is 0"),
    ],
)
def test_every_stage_is_checked_before_the_first_one_starts(
    recipes: Any, tmp_path: Path, override: str | tuple[str, ...], says: str
) -> None:
    overrides = [override] if isinstance(override, str) else override
    settings = settings_of("preset=smoke", f"run_dir={tmp_path}", *overrides)
    with pytest.raises(BMRLError, match=says):
        check(settings)


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
    pytest.importorskip("robosuite", exc_type=ImportError)  # two_stage.py imports it
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


def test_what_was_imported_is_not_searched_whenever_an_environment_closes(
    recipes: Any, tmp_path: Path
) -> None:
    left_alone: list[int] = []
    gc.unfreeze()
    recipes.run_recipe(
        configured("preset=smoke", f"run_dir={tmp_path}"),
        lambda run: left_alone.append(gc.get_freeze_count()),
    )
    assert left_alone[0] > 100_000


def test_rows_that_are_read_back_are_reported_as_the_steps_that_they_took(
    recipes: Any, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    from torchrl_bmrl.pipeline.evaluate import evaluate_once

    run = make_run(tmp_path, "tasks={lift:{task:lift,horizon:7}}", "evaluate.episodes=3")
    (tmp_path / "evaluation").mkdir()
    row = ResultRow(
        task="lift",
        policy="bcq",
        seed=run.settings.seed,
        episode=0,
        episode_return=1.0,
        success=True,
    )
    write_results(tmp_path / "evaluation" / "lift-bcq.csv", [row])
    reported: list[int] = []
    evaluate_once(run, "lift", "bcq", lambda _: [], report=reported.append)
    assert reported == [7 * 3]


PRESETS = sorted(path.stem for path in (RECIPES / "config" / "preset").glob("*.yaml"))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_complete_and_valid(recipes: Any, tmp_path: Path, preset: str) -> None:
    settings = settings_of(f"preset={preset}", f"run_dir={tmp_path}")
    settings.check()
    families = {"family": "push_towards", "ml1": "ml1_push"}
    if preset in families:
        assert Run(settings).family.name == families[preset]
        return
    assert list(Run(settings).names) == [
        "reach",
        "lift",
        "push_right",
        "push_left",
        "push_up",
        "push_down",
    ]


def test_the_presets_but_quick_and_paper_keep_the_learning_rate_that_they_were_measured_with(
    recipes: Any, tmp_path: Path
) -> None:
    for preset in PRESETS:
        settings = settings_of(f"preset={preset}", f"run_dir={tmp_path}")
        rate = 3e-3 if preset in ("quick", "paper") else 1e-3
        assert (settings.bcq.lr, settings.distill.lr) == (rate, rate), preset


def test_the_presets_differ_in_what_their_names_say(recipes: Any, tmp_path: Path) -> None:
    paper, literal, long, quick = (
        settings_of(f"preset={preset}", f"run_dir={tmp_path}")
        for preset in ("paper", "literal", "long", "quick")
    )
    assert list(Run(paper).settings.collect.train_episodes.values()) == [500, 500, *[100] * 4]
    assert literal.distill.context_fraction == literal.distill.latent_norm_weight == 0.0
    assert literal.distill.encoder_terms == ["classification"]
    assert literal.bcq == long.bcq
    assert long.bcq.epochs * long.bcq.updates_per_epoch == 5000
    assert replace(long, preset="quick", bcq=quick.bcq, distill=quick.distill) == quick
    assert configured(f"run_dir={tmp_path}") == configured("preset=quick", f"run_dir={tmp_path}")


def test_only_is_refused_by_a_command_that_does_not_split_its_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert command_line("distill", "only=[lift]", f"run_dir={folder}") == 1
    assert "only is ['lift']; valid: null, except with train_bcq.py" in capsys.readouterr().err
    assert not folder.exists()


ABLATIONS = sorted(path.stem for path in (RECIPES / "config" / "ablation").glob("*.yaml"))


OF_WEAK = {
    *("acting_100", "acting_first", "autoencoder", "chunks_4", "critics_2", "flow", "gamma_99"),
    "mixture",
    *("no_advantage", "no_layer_norm", "published", "raw_rewards", "steps_1", "steps_5"),
    "target_min",
}
"""Ablations that undo a step of the preset ``weak``; others may have it undone already."""


@pytest.mark.parametrize(
    ("preset", "ablation"),
    [(preset, x) for preset in ("quick", "paper") for x in ABLATIONS if x not in OF_WEAK]
    + [("weak", x) for x in sorted(OF_WEAK)],
)
def test_an_ablation_is_valid_and_changes_one_group_of_settings_of_any_preset(
    recipes: Any, tmp_path: Path, preset: str, ablation: str
) -> None:
    plain, config = (
        settings_of(f"preset={preset}", f"ablation={name}", f"run_dir={tmp_path}")
        for name in ("none", ablation)
    )
    check(config)
    assert (config.preset, config.ablation) == (preset, ablation)
    groups = [group for group, value in vars(plain).items() if value != getattr(config, group)]
    if ablation == "none":
        assert not groups
    elif (preset, ablation) == ("paper", "demos_all"):  # what it has anyway
        assert groups == ["ablation"]
    elif ablation == "one_hot":  # acts on a point alone, where the paper preset has three sources
        assert {"ablation", "distill"} <= set(groups) <= {"ablation", "distill", "evaluate"}
    elif ablation == "published":
        assert groups == ["ablation", "bcq", "evaluate"]
    else:
        assert len(groups) == 2


def test_the_published_stage_1_has_the_settings_of_the_published_presets(
    recipes: Any, tmp_path: Path
) -> None:
    long, config = (
        settings_of(f"preset={preset}", f"ablation={name}", f"run_dir={tmp_path}")
        for preset, name in (("long", "none"), ("weak", "published"))
    )
    size = {"epochs", "batch_size"}
    differing = {k for k, x in vars(long.bcq).items() if x != getattr(config.bcq, k)}
    assert differing == size
    assert long.evaluate.num_candidates == config.evaluate.num_candidates


def test_the_settings_of_stage_1_in_the_docs_are_those_of_the_presets(
    recipes: Any, tmp_path: Path
) -> None:
    page = (RECIPES.parent / "docs" / "pipeline.md").read_text(encoding="utf-8")
    section = page.split("## Settings of stage 1\n")[1].split("\n## ")[0]
    found = re.findall(r"^\| `(\w+)\.(\w+)` \| `?([^|`]+?)`? \| `?([^|`]+?)`? \|", section, re.M)
    assert len(found) == 14
    presets = [settings_of(f"preset={name}", f"run_dir={tmp_path}") for name in ("quick", "weak")]
    for group, name, *shown in found:
        for preset, text in zip(presets, shown, strict=True):
            value = getattr(getattr(preset, group), name)
            if text != "not used":
                assert text == (str(value).lower() if isinstance(value, bool) else f"{value}"), name


def test_what_each_ablation_takes_away_is_away(recipes: Any, tmp_path: Path) -> None:
    def ablated(name: str) -> Any:
        return settings_of(f"ablation={name}", f"run_dir={tmp_path}")

    assert ablated("no_direction").distill.direction_weight == 0
    assert ablated("no_isometry").distill.isometry_weight == 0
    assert ablated("detached").distill.encoder_terms == ["classification"]
    assert [ablated(f"dim{n}").distill.task_latent_dim for n in (4, 8)] == [4, 8]
    assert ablated("one_hot").distill.task_encoder == "one_hot"
    assert ablated("perturbation").bcq.perturbation
    assert ablated("latent_clip_none").bcq.latent_clip is None
    assert ablated("candidates_2").bcq.num_candidates == 2
    for generator in ("autoencoder", "flow", "mixture"):
        assert ablated(generator).bcq.generator == generator
    assert [ablated(f"steps_{n}").bcq.n_steps for n in (1, 5)] == [1, 5]
    assert ablated("chunks_4").bcq.action_chunk == 4
    assert ablated("no_advantage").distill.advantage_weight == 0
    assert not ablated("no_layer_norm").bcq.layer_norm
    assert not ablated("raw_rewards").bcq.standard_reward
    assert (ablated("target_min").bcq.target_rule, ablated("target_min").bcq.lmbda) == (
        "clipped",
        1,
    )
    assert ablated("critics_2").bcq.num_qvalue_nets == 2
    assert ablated("gamma_99").bcq.gamma == 0.99
    assert [ablated(f"acting_{n}").evaluate.num_candidates for n in (1, 10, 100)] == [1, 10, 100]
    assert [ablated(f"noise_{n}").collect.noise for n in (0, 40)] == [0.0, 0.4]
    for n in (10, 50, 100):
        assert set(Run(ablated(f"demos_{n}")).settings.collect.train_episodes.values()) == {n}
    paper = settings_of("preset=paper", f"run_dir={tmp_path}")
    assert ablated("demos_all").collect == paper.collect
