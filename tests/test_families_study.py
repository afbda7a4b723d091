"""The study of held-out members, and all of a run whose student reads sets of transitions."""

from __future__ import annotations

import csv
import shutil
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("sklearn")
pytest.importorskip("tqdm")

import tiny_family
from small_runs import contents
from tiny_family import FAMILY, HORIZON, make_walk

from torchrl_bmrl.data.robomimic import read_kept_episode
from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.pipeline import Run, evaluate, stage2, two_stage
from torchrl_bmrl.pipeline.export import export
from torchrl_bmrl.pipeline.student import load_student
from torchrl_bmrl.rows import write_rows
from torchrl_bmrl.studies import families, families_methods
from torchrl_bmrl.studies.families import generalise
from torchrl_bmrl.studies.families_methods import METHODS, OWN, make_method
from torchrl_bmrl.tasks import DemonstrationFiles
from torchrl_bmrl.training.checkpoint import load_checkpoint

STUDY = tiny_family.study()
HELD_OUT = ("walk_60", "walk_150")


pytestmark = pytest.mark.usefixtures("walk_family")


@pytest.fixture(scope="module")
def trained(walk_family: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of both stages, evaluated. Tests only read it."""
    folder = tmp_path_factory.mktemp("trained")
    sources = ["prototype", "online", "demonstration"]
    with Run(configured(folder, sources)) as run:
        two_stage(run)
    return folder


def configured(folder: Path, sources: list[str] | None = None, **changes: Any) -> Any:
    settings = tiny_family.settings(folder, **changes)
    sources = sources or ["prototype", "online", "demonstration"]
    return replace(settings, evaluate=replace(settings.evaluate, latent_sources=sources))


@pytest.fixture(scope="module")
def studied(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The same with the study, and what it says. Tests only read it."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("studied") / "run")
    with Run(configured(folder)) as run:
        return folder, generalise(run, STUDY)


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    return shutil.copytree(trained, tmp_path / "run")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


# -- the study -------------------------------------------------------------------------------------


def test_every_method_plays_every_held_out_member(studied: tuple[Path, str]) -> None:
    folder, said = studied
    found = rows(folder / "families" / "results.csv")
    keys = {(row["method"], row["split"], row["member"], row["episode"]) for row in found}
    members = (("inside", "walk_60"), ("outside", "walk_150"))
    assert keys == {(name, *member, i) for name in METHODS for member in members for i in "01"}
    assert len(found) == len(keys) == len(METHODS) * len(HELD_OUT) * 2
    assert said.startswith((folder / "tables" / "families.md").read_text().strip()[:40])
    assert all(title in said for title in METHODS.values())


def test_a_demonstration_of_a_held_out_member_is_cloned(studied: tuple[Path, str]) -> None:
    found = rows(studied[0] / "families" / "results.csv")
    assert not any(row["member"] in ("walk_0", "walk_40") for row in found)
    for row in found:
        assert row["success"] in ("0", "1")
        assert abs(float(row["return"])) < HORIZON


def test_a_row_has_the_return_of_the_demonstration_that_the_policy_is_given(
    studied: tuple[Path, str],
) -> None:
    for row in rows(studied[0] / "families" / "results.csv"):
        file = f"{row['member']}-demonstration-{row['episode']}.npz"
        given = read_kept_episode(studied[0] / "families" / "contexts" / file)
        assert float(row["data_return"]) == pytest.approx(given.rewards.sum(), rel=1e-6)
        assert row["family"] == "walk"
    run = Run(configured(studied[0]))
    without = replace(make_walk(60.0), record=None, files=DemonstrationFiles(path="no.hdf5"))
    assert families.data_return(run, replace(STUDY, methods=["told"]), without, 0) == ""


def test_a_method_s_file_of_an_earlier_version_is_refused_by_name(
    folder: Path, studied: tuple[Path, str]
) -> None:
    shutil.rmtree(folder)
    shutil.copytree(studied[0], folder)
    path = folder / "families" / "told" / "walk_60.csv"
    kept = ("method", "split", "member", "episode", "return", "success")
    write_rows(path, [{key: row[key] for key in kept} for row in rows(path)])
    with (
        Run(configured(folder)) as run,
        pytest.raises(BMRLError, match=r"told/walk_60\.csv.*family"),
    ):
        generalise(run, STUDY)


def test_the_line_between_members_is_measured(studied: tuple[Path, str]) -> None:
    found = rows(studied[0] / "families" / "lines.csv")
    assert {row["code"] for row in found} == {"m", "one_hot"}
    assert {(row["start"], row["end"]) for row in found} == {("walk_0", "walk_120")}


def test_a_study_that_was_stopped_goes_on_to_the_same_files(
    folder: Path, studied: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    played = 0
    original = families._play

    def play(*args: Any) -> None:
        nonlocal played
        played += 1
        if played == 12:
            raise KeyboardInterrupt
        original(*args)

    monkeypatch.setattr(families, "_play", play)
    with Run(configured(folder)) as run, pytest.raises(KeyboardInterrupt):
        generalise(run, STUDY)
    assert not (folder / "families" / "results.csv").exists()
    with Run(configured(folder)) as run:
        said = generalise(run, STUDY)
    assert said == studied[1]
    patterns = ("families/*.csv", "families/*/*.csv", "families/*/checkpoint.safetensors")
    assert contents(folder, *patterns) == contents(studied[0], *patterns)
    # Once more nothing is played, and an episode that was lost comes back as it was.
    (folder / "families" / "one_shot" / "walk_60.csv").unlink()
    with Run(configured(folder)) as run:
        assert generalise(run, STUDY) == said
    assert played == 12 + 15 + 1
    assert contents(folder, *patterns) == contents(studied[0], *patterns)


def test_a_study_is_held_to_its_own_settings(studied: tuple[Path, str]) -> None:
    with Run(configured(studied[0])) as run, pytest.raises(ConfigError, match="episodes is 3 here"):
        generalise(run, replace(STUDY, episodes=3))


def test_the_students_of_the_comparison_know_what_they_are_told(studied: tuple[Path, str]) -> None:
    run = Run(configured(studied[0]))
    _, told_m = make_method(run, STUDY, make_walk(60.0), "told")
    assert told_m.task_latent.tolist() == pytest.approx(FAMILY.told("walk_60"))
    _, near = make_method(run, STUDY, make_walk(150.0), "one_hot")
    assert near.task_latent.tolist() == [0, 0, 0, 1]  # 120 is the nearest
    _, nothing = make_method(run, STUDY, make_walk(60.0), "no_context")
    assert nothing.task_latent.tolist() == [0]
    for method in ("told", "one_hot", "no_context"):
        student, metadata = load_student(
            studied[0] / "families" / method / "checkpoint.safetensors"
        )
        assert student.context_encoder is None
        assert metadata["accuracy"] is None
        assert metadata["updates"] == 4


def test_each_episode_is_given_contexts_of_its_own(studied: tuple[Path, str]) -> None:
    run = Run(configured(studied[0]))
    student = run.student()[0]
    task = make_walk(60.0)
    for method, reads in (("demonstration", student.embed_context), ("behaviour", student.infer)):
        given = [families_methods.context(run, STUDY, task, method, i) for i in (0, 1)]
        assert [len(each) for each in given] == [HORIZON, HORIZON]
        assert not torch.equal(given[0]["action"], given[1]["action"])
        _, source = make_method(run, STUDY, task, method)
        points = torch.stack([reads(each) for each in given])
        torch.testing.assert_close(source.task_latent, points)
    twice = replace(STUDY, demonstrations=2)
    second = families_methods.context(run, twice, task, "demonstration", 1)
    assert len(second) == 2 * HORIZON
    assert not torch.equal(second["action"][:HORIZON], given[1]["action"])


def test_one_shot_starts_with_the_own_first_episode_and_reads_on(
    studied: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(configured(studied[0]))
    task = make_walk(60.0)
    learner = families_methods.load_learner(run, STUDY, OWN)
    source = families_methods.after_first_episodes(run, STUDY, task, learner)
    with closing(run.make_env(task, source, num_envs=STUDY.episodes)) as env:
        second = env.rollout(3, learner.policy)
    assert source.counts.shape == (STUDY.episodes, HORIZON)
    assert source.counts.all()
    latents = second["task_latent"]
    assert not torch.equal(latents[0, 0], latents[1, 0])  # of different first episodes
    assert not torch.equal(latents[:, 0], latents[:, 2])
    played = families_methods.rollout_episodes

    def ended(*args: Any, **options: Any) -> Any:
        data = played(*args, **options)
        data["next", "done"][0, 2:] = True  # one episode ends at its third step
        return data

    monkeypatch.setattr(families_methods, "rollout_episodes", ended)
    source = families_methods.after_first_episodes(run, STUDY, task, learner)
    assert source.counts.sum(-1).tolist() == [3, HORIZON]


def test_a_first_episode_tries_several_trained_members(studied: tuple[Path, str]) -> None:
    run = Run(configured(studied[0]))
    learner = families_methods.load_learner(run, STUDY, OWN)
    six = replace(STUDY, episodes=6)
    paths = families_methods.trying(run, six, make_walk(60.0), learner).points
    assert paths.shape[:2] == (6, HORIZON)
    for path in paths:
        tried = {tuple(latent.tolist()) for latent in path}
        assert tried <= {tuple(point.tolist()) for point in learner.prototypes}
        assert len(tried) == min(families_methods.TRIED, len(learner.prototypes))
    assert not all(torch.equal(paths[0], other) for other in paths[1:])


def test_a_student_knows_how_large_rewards_and_steps_are(trained: Path) -> None:
    run = Run(configured(trained))
    data = [run.transitions(name, split) for name in run.names for split in ("train", "context")]
    reward = torch.cat([each["next", "reward"] for each in data])
    student = run.student()[0]
    for encoder in (student.task_encoder, student.context_encoder):
        torch.testing.assert_close(encoder.module.reward_loc, reward.mean(0))
        torch.testing.assert_close(encoder.module.reward_scale, reward.std(0))


def test_held_out_members_have_the_run_s_options(folder: Path) -> None:
    run = Run(replace(configured(folder), stepper="robosuite"))
    assert {task.options["stepper"] for task in run.tasks} == {"robosuite"}
    members = families.held_out_members(run)
    assert [task.name for _, task in members] == list(HELD_OUT)
    assert {task.options["stepper"] for _, task in members} == {"robosuite"}
    assert run.horizon(members[0][1]) == HORIZON
    assert run.horizon(replace(members[0][1], horizon=None)) == HORIZON


def test_a_run_without_contexts_of_another_behaviour_has_no_such_method(tmp_path: Path) -> None:
    settings = tiny_family.settings(
        tmp_path, {"context": "set", "inference_updates": 0, "reward_updates": 0}
    )
    settings = replace(settings, collect=replace(settings.collect, context_episodes=0))
    with Run(settings) as run, pytest.raises(BMRLError, match=r"checkpoint.safetensors"):
        generalise(run, STUDY)  # no policy yet


def test_members_without_pictures_are_points_alone_and_are_not_played(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(families, "why_no_films", lambda: "")
    with Run(configured(folder)) as run:
        found = families.explore(run, STUDY, families.held_out_members(run))
    assert "the environments of these tasks make no pictures." in found.caption
    assert not (folder / "families" / "films").exists()


def test_a_policy_that_reads_no_transitions_cannot_be_given_any(
    tmp_path: Path, trained: Path
) -> None:
    for part in ("data", "bcq"):
        shutil.copytree(trained / part, tmp_path / part)
    told = {"task_encoder": "told", "context": "current", "inference_updates": 0}
    told |= {"reward_updates": 0}
    with Run(configured(tmp_path, ["prototype"], distill=told)) as run:
        stage2(run)
        assert run.student()[0].prototypes.shape == (4, 2)
        with pytest.raises(BMRLError, match=r"reads .'task'.*valid: single transitions"):
            generalise(run, STUDY)
    assert not (tmp_path / "families").exists()


# -- a run with an encoder of sets -----------------------------------------------------------------


def test_every_source_of_m_is_evaluated_and_the_expert_s_contexts_are_not(trained: Path) -> None:
    found = read_results(trained / "results.csv")
    sources = {row.latent_source for row in found if row.policy == "distilled"}
    assert sources == {"prototype", "online", "demonstration"}
    experts = [row for row in found if row.policy == "expert" and row.task == "walk_0"]
    assert len(experts) == 3  # two to train on and one held out
    assert all(row.success for row in experts)


def test_without_episodes_during_stage_1_a_run_has_no_curves(trained: Path, tmp_path: Path) -> None:
    settings = configured(tmp_path)
    with Run(replace(settings, bcq=replace(settings.bcq, eval_episodes=0))) as run:
        two_stage(run)
    assert not list(tmp_path.glob("bcq/*/evaluations.csv"))
    assert "no evaluations were found" in (tmp_path / "report.html").read_text()
    assert contents(tmp_path, "results.csv") == contents(trained, "results.csv")


def test_a_student_is_trained_with_mixed_lessons_and_relabelled_contexts(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for part in ("data", "bcq"):
        shutil.copytree(trained / part, tmp_path / part)
    module: Any = sys.modules[stage2.__module__]  # the package's function hides its name
    names = ("make_distillation_loss", "ContextSampler", "warn_of_marks")
    loss, sampler, warn = mocks = [Mock(wraps=getattr(module, name)) for name in names]
    for name, mock in zip(names, mocks, strict=True):
        monkeypatch.setattr(module, name, mock)
    with Run(configured(tmp_path, distill={"mixing_fraction": 0.25})) as run:
        stage2(run)
        data = [run.transitions(name, x) for name in run.names for x in ("train", "context")]
    assert loss.call_args.kwargs["mixing_fraction"] == 0.25
    assert len(warn.call_args.args[0]) == len(run.names)
    reward = torch.cat([each["next", "reward"] for each in data])
    models = sampler.call_args.args[3]
    torch.testing.assert_close(models.module.reward_scale, reward.std(0))


def test_no_accuracy_is_reported_without_a_classifier(trained: Path) -> None:
    _, metadata = load_student(trained / "distill" / "checkpoint.safetensors")
    assert metadata["accuracy"] is None
    assert metadata["updates"] == 4 + 4
    assert "linear layer" not in (trained / "report.html").read_text()


def test_a_policy_that_reads_sets_is_exported_and_evaluated(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    with Run(configured(folder)) as run:
        export(run)
    card = (folder / "policy.md").read_text()
    assert "its classifier" not in card
    assert "linear layer" not in card
    state, _ = load_checkpoint(folder / "policy.safetensors", kind="student")
    assert set(state["demonstrations"]) == {"walk_0", "walk_40", "walk_80", "walk_120"}
    settings = configured(tmp_path / "again")
    exported = replace(settings.evaluate, policy=str(folder / "policy.safetensors"))
    shutil.copytree(folder / "data", tmp_path / "again" / "data")
    with Run(replace(settings, evaluate=exported)) as run:
        evaluate(run)
    again = [(row.task, row.latent_source, row.episode_return) for row in again_rows(tmp_path)]
    first = [
        (row.task, row.latent_source, row.episode_return)
        for row in read_results(folder / "results.csv")
        if row.policy == "distilled"
    ]
    assert sorted(again) == sorted(first)


def again_rows(tmp_path: Path) -> Any:
    return read_results(tmp_path / "again" / "results.csv")


@pytest.mark.parametrize(("stop", "updates"), [(2, 2), (4, 4), (7, 4), (9, 6)])
def test_a_distillation_that_was_stopped_goes_on_to_the_same_student(
    trained: Path, tmp_path: Path, stop: int, updates: int
) -> None:
    for part in ("data", "bcq"):
        shutil.copytree(trained / part, tmp_path / part)
    with Run(configured(tmp_path)) as run:
        from torchrl_bmrl.pipeline.stage2 import StudentJob, train_student

        def report(updates: int, done: list[int] = []) -> None:  # noqa: B006
            done.append(updates)
            if sum(done) > stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train_student((run, StudentJob(run.settings.distill, "distill")), report)
        assert load_student(run.student_path)[1]["updates"] == updates
        rewards = run.folder / "distill" / "rewards" / "checkpoint.safetensors"
        assert rewards.exists() == (stop >= 7)
        stage2(run)
    expected, found = (
        load_student(x / "distill" / "checkpoint.safetensors")[0].state_dict()
        for x in (trained, tmp_path)
    )
    assert all(torch.equal(found[key], value) for key, value in expected.items())
