"""The study of held-out members, and all of a run whose student reads sets of transitions."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

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

from torchrl_bmrl.data.robomimic import open_episodes, read_kept_episode
from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.evaluation import read_results
from torchrl_bmrl.experts.collect import WANDERING
from torchrl_bmrl.files import write_rows
from torchrl_bmrl.pipeline import Run, collect, evaluate, stage2, two_stage
from torchrl_bmrl.pipeline.export import export
from torchrl_bmrl.pipeline.student import load_student
from torchrl_bmrl.studies import families
from torchrl_bmrl.studies.families import METHODS, FamilySettings, generalise, make_method
from torchrl_bmrl.tasks import FAMILIES
from torchrl_bmrl.training.checkpoint import load_checkpoint

STUDY = FamilySettings(episodes=2, cloning_updates=3)
HELD_OUT = ("walk_60", "walk_150")


@pytest.fixture(scope="module", autouse=True)
def family() -> Iterator[None]:
    tiny_family.register()
    yield
    del FAMILIES["walk"]


@pytest.fixture(scope="module")
def trained(family: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
        path = studied[0] / "families" / "contexts" / f"{row['member']}-demonstration-0.npz"
        given = read_kept_episode(path)
        assert float(row["data_return"]) == pytest.approx(given.rewards.sum(), rel=1e-6)
        assert row["family"] == "walk"
    run = Run(configured(studied[0]))
    assert (
        families.data_return(
            run, STUDY, replace(make_walk(60.0), record=None, files=("walk.hdf5",))
        )
        == ""
    )


def test_a_study_of_an_earlier_version_gets_the_new_columns_without_playing(
    folder: Path, studied: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(folder)
    shutil.copytree(studied[0], folder)
    path = folder / "families" / "results.csv"
    now, kept = path.read_text(), ("method", "split", "member", "episode", "return", "success")
    write_rows(path, [{key: row[key] for key in kept} for row in rows(path)])
    monkeypatch.setattr(families, "_play", pytest.fail)
    with Run(configured(folder)) as run:
        generalise(run, STUDY)
    assert path.read_text() == now


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
    assert played == 12 + 7 + 1
    assert contents(folder, *patterns) == contents(studied[0], *patterns)


def test_a_study_is_held_to_its_own_settings(studied: tuple[Path, str]) -> None:
    with Run(configured(studied[0])) as run, pytest.raises(ConfigError, match="episodes is 3 here"):
        generalise(run, replace(STUDY, episodes=3))


def test_the_students_of_the_comparison_know_what_they_are_told(studied: tuple[Path, str]) -> None:
    run = Run(configured(studied[0]))
    _, told_m = make_method(run, STUDY, make_walk(60.0), "told")
    assert told_m.tolist() == pytest.approx(FAMILY.told("walk_60"))
    _, near = make_method(run, STUDY, make_walk(150.0), "one_hot")
    assert near.tolist() == [0, 0, 0, 1]  # 120 is the nearest
    _, nothing = make_method(run, STUDY, make_walk(60.0), "no_context")
    assert nothing.tolist() == [0]
    for method in ("told", "one_hot", "no_context"):
        student, metadata = load_student(
            studied[0] / "families" / method / "checkpoint.safetensors"
        )
        assert student.context_encoder is None
        assert metadata["accuracy"] is None
        assert metadata["updates"] == 4


def test_m_of_a_demonstration_is_that_of_the_student_and_of_another_behaviour_is_inferred(
    studied: tuple[Path, str],
) -> None:
    run = Run(configured(studied[0]))
    student = run.student()[0]
    task = make_walk(60.0)
    for method, reads in (("demonstration", student.embed_context), ("behaviour", student.infer)):
        given = families.context(run, STUDY, task, method)
        assert len(given) == HORIZON
        torch.testing.assert_close(make_method(run, STUDY, task, method)[1], reads(given))
    twice = replace(STUDY, demonstrations=2)
    assert len(families.context(run, twice, task, "one_shot")) == 2 * HORIZON


def test_a_first_episode_tries_several_trained_members(studied: tuple[Path, str]) -> None:
    run = Run(configured(studied[0]))
    student = run.student()[0]
    latents = families.first_latents(run, student, make_walk(60.0), 0)
    assert len(latents) == HORIZON
    tried = {tuple(latent.tolist()) for latent in latents}
    assert tried <= {tuple(point.tolist()) for point in student.prototypes}
    assert len(tried) == min(WANDERING, len(student.prototypes))
    others = [families.first_latents(run, student, make_walk(60.0), i) for i in range(1, 6)]
    assert not all(torch.equal(latents, other) for other in others)


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
    settings = tiny_family.settings(tmp_path, {"context": "set", "inference_updates": 0})
    settings = replace(settings, collect=replace(settings.collect, context_episodes=0))
    with Run(settings) as run:
        with pytest.raises(BMRLError, match=r"checkpoint.safetensors"):
            generalise(run, STUDY)  # no policy yet
        collect(run)
        for name in run.names:
            assert set(masks(run.demonstrations(name))) == {"train", "valid"}


def test_tasks_of_no_family_are_refused(tmp_path: Path) -> None:
    settings = replace(tiny_family.settings(tmp_path), tasks=["walk_0", "walk_40"])
    with Run(settings) as run, pytest.raises(ConfigError, match="valid: the trained members of"):
        generalise(run, STUDY)
    assert not (tmp_path / "families").exists()


def test_a_policy_that_reads_no_transitions_cannot_be_given_any(
    tmp_path: Path, trained: Path
) -> None:
    for part in ("data", "bcq"):
        shutil.copytree(trained / part, tmp_path / part)
    told = {"task_encoder": "told", "context": "current", "inference_updates": 0}
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


def test_no_accuracy_is_reported_without_a_classifier(trained: Path) -> None:
    _, metadata = load_student(trained / "distill" / "checkpoint.safetensors")
    assert metadata["accuracy"] is None
    assert metadata["updates"] == 4 + 2
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


@pytest.mark.parametrize("stop", [2, 4])
def test_a_distillation_that_was_stopped_goes_on_to_the_same_student(
    trained: Path, tmp_path: Path, stop: int
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
        assert load_student(run.student_path)[1]["updates"] == stop
        stage2(run)
    expected, found = (
        load_student(x / "distill" / "checkpoint.safetensors")[0].state_dict()
        for x in (trained, tmp_path)
    )
    assert all(torch.equal(found[key], value) for key, value in expected.items())


# -- contexts of another behaviour -----------------------------------------------------------------


def masks(path: Path) -> dict[str, int]:
    found = {}
    for name in ("train", "valid", "context"):
        try:
            with open_episodes(path, split=name, observation_keys=[]) as episodes:
                found[name] = len(episodes)
        except BMRLError:
            continue
    return found


def test_context_episodes_are_of_other_members_experts_and_apart(trained: Path) -> None:
    path = trained / "data" / "walk_40.hdf5"
    assert masks(path) == {"train": 2, "valid": 1, "context": 2}
    for split in ("train", "valid", "context"):
        with open_episodes(path, split=split, observation_keys=[]) as episodes:
            for _, episode in episodes.items():
                like = str(episode.attributes.get("like", ""))
                assert bool(like) == (split == "context")
                assert "walk_40" not in like
    run = Run(configured(trained))
    first, second = (run.transitions("walk_40", split) for split in ("train", "context"))
    assert len(first) == len(second) == 2 * HORIZON
    # The data are normalised by the demonstrations alone.
    every = torch.cat([run.transitions(name, "train")["observation"] for name in run.names])
    torch.testing.assert_close(every.mean(0), torch.zeros(2), atol=1e-5, rtol=0)


def test_the_number_of_context_episodes_does_not_change_the_demonstrations(
    trained: Path, tmp_path: Path
) -> None:
    settings = tiny_family.settings(tmp_path, {"context": "set", "inference_updates": 0})
    with Run(replace(settings, collect=replace(settings.collect, context_episodes=0))) as run:
        collect(run)
        for name in run.names:
            mine, theirs = (
                Run(configured(x)).transitions(name, "train") for x in (tmp_path, trained)
            )
            assert torch.equal(mine["action"], theirs["action"])
            assert torch.equal(mine["observation"], theirs["observation"])
